"""March along rays through a grid of occupied cells, and keep the intervals whose middle is in one.

The intervals of all rays come from one lattice of distances: interval k of a ray begins at
e[k] + jitter (e[k+1] - e[k]).
"""

from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import cpu_backend, cuda_backend
from nerf_lightning.nerf.kernels.march.grid import MarchState, OccupancyCells
from nerf_lightning.nerf.types.rays import RaggedSamples, RayBundle


def march(
    rays: RayBundle,
    state: MarchState,
    lattice: Float[Tensor, "edges"],
    grid: OccupancyCells,
    limit: int | None = None,
    capacity: int | None = None,
) -> tuple[RaggedSamples, Int[Tensor, "rays"]]:
    """Return the occupied intervals, at most `limit` per ray, and where each ray would continue.

    Args:
        rays: unit directions.
        state: bounds, jitter and position of each ray.
        lattice: increasing distances; two more than there are intervals.
        grid: the occupied cells.
        limit: maximum number of samples per ray; None for all.
        capacity: size of the returned arrays, so that no size is read on the host; what does not fit is dropped from
            the last rays. None: as many as there are.
    """
    backend = cpu_backend("march.cpu", rays.near.device)
    if backend is not None and capacity is None:
        return backend.march(rays, state, lattice, grid, limit)
    backend = cuda_backend("march.cuda", rays.near.device)
    if backend is not None:
        return backend.march(rays, state, lattice, grid, limit, capacity)
    from nerf_lightning.nerf.kernels.march.reference import march_torch

    return march_torch(rays, state, lattice, grid, limit, capacity)

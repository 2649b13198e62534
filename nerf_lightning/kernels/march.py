"""March along rays through a grid of occupied cells, and keep the intervals whose middle lies in one.

The intervals of all rays come from one lattice of distances: interval k of a ray begins at
e[k] + jitter (e[k+1] - e[k]). Cascade c of the grid is the box, enlarged 2^c times about its centre.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from nerf_lightning.kernels.backends import cpu_twin
from nerf_lightning.types.rays import PackedSamples, RayBundle
from nerf_lightning.types.tensor_struct import TensorStruct

BLOCK = 4
"""Side of the blocks of cells that are skipped at once where all are empty."""
OPAQUE = 12.0
"""Optical depth, by the floor of the cells' densities, behind which nothing is kept."""


@dataclass(frozen=True)
class OccupancyCells(TensorStruct):
    """Which cells may hold something."""

    aabb: Float[Tensor, "2 3"]
    """The box of cascade 0."""
    cells: UInt8[Tensor, "cascades x y z"]
    """1 where occupied."""
    blocks: UInt8[Tensor, "cascades a b c"]
    """1 where any cell of a block is."""
    floor: Float[Tensor, "cascades x y z"]
    """About the smallest density in each cell: a march ends where so much matter lies before it that nothing behind
    can be seen, even by this cautious guess."""


def blocks_of(cells: UInt8[Tensor, "cascades x y z"]) -> UInt8[Tensor, "cascades a b c"]:
    """Return which blocks of cells hold an occupied one; the grid's side is a multiple of 4."""
    return torch.nn.functional.max_pool3d(cells.float(), BLOCK).to(torch.uint8)


@dataclass(frozen=True)
class March(TensorStruct):
    """Where each ray's march stands: rays may be marched a few samples at a time."""

    enter: Float[Tensor, "rays"]
    """Distances between which samples are wanted."""
    leave: Float[Tensor, "rays"]
    jitter: Float[Tensor, "rays"]
    """In [0, 1)."""
    next: Int[Tensor, "rays"]
    """The lattice interval to go on with."""


def march(
    rays: RayBundle,
    state: March,
    lattice: Float[Tensor, "edges"],
    grid: OccupancyCells,
    limit: int | None = None,
    capacity: int | None = None,
) -> tuple[PackedSamples, Int[Tensor, "rays"]]:
    """Return the occupied intervals, at most `limit` per ray, and where each ray would go on.

    Args:
        rays: unit directions.
        state: bounds, jitter and place of each ray.
        lattice: increasing distances; two more than there are intervals.
        grid: what is occupied.
        limit: most samples of a ray; None for all.
        capacity: size of the arrays returned, read nowhere on the host, and what does not fit is dropped from the
            last rays; None for as many as there are.
    """
    twin = cpu_twin("march_numba", rays.near.device)
    if twin is not None and capacity is None:
        return twin.march(rays, state, lattice, grid, limit)
    from nerf_lightning.kernels.march_torch import march_torch

    return march_torch(rays, state, lattice, grid, limit, capacity)

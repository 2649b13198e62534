"""Rays rendered from end to end in one kernel, where there is one for the machine, the field and its precision."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import is_on, twin
from nerf_lightning.nerf.kernels.march.grid import March, OccupancyCells
from nerf_lightning.nerf.kernels.render.parts import FieldParts
from nerf_lightning.nerf.products import Products, cpu_multiplies_bfloat16
from nerf_lightning.nerf.types.rays import RayBundle

WHOLE = "render.bfloat16"


def can_render_whole(field: FieldParts, products: Products, device: torch.device) -> bool:
    """Tell whether there is such a kernel: for CPUs that multiply bfloat16, and widths that are whole vectors."""
    if device.type != "cpu" or products != "bfloat16" or not cpu_multiplies_bfloat16():
        return False
    kernels = twin("mlp.bfloat16") if is_on(WHOLE) and is_on("mlp.bfloat16") else None
    if kernels is None or not all(kernels.takes([w.shape[1] for w in weights]) for weights in field.weights):
        return False
    return twin(WHOLE) is not None


def render_whole(
    rays: RayBundle,
    field: FieldParts,
    state: March,
    lattice: Float[Tensor, "edges"],
    grid: OccupancyCells,
    least_alpha: float,
    opaque_below: float,
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"], Float[Tensor, "rays"]]:
    """Return, per ray, sum of w rgb, sum of w, and sum of w t, in the letters of `rendering.quadrature`.

    Args:
        rays: unit directions, scene units.
        field: what is asked about the samples.
        state: where each ray's march begins.
        lattice: the intervals (`kernels.march`).
        grid: which of them are asked about.
        least_alpha: less opaque samples count with their density and without their colour.
        opaque_below: a ray ends where less light than this is left.
    """
    kernels = twin(WHOLE)
    assert kernels is not None  # `can_render_whole` was asked
    return kernels.render(rays, field, state, lattice, grid, least_alpha, opaque_below)

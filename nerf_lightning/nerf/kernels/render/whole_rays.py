"""Rays rendered from end to end in one kernel: the one front of these kernels, for any level that has a march."""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import cpu_backend, is_on
from nerf_lightning.nerf.kernels.march.grid import GridMarch
from nerf_lightning.nerf.kernels.render.parts import FieldParts
from nerf_lightning.nerf.matmul_precision import MatmulPrecision
from nerf_lightning.nerf.types.rays import RayBundle

LEARNING, RENDERING = "render.gradients", "render.cpu"


class WholeRays(NamedTuple):
    """What a kernel saw along each ray."""

    rgb: Float[Tensor, "rays 3"]
    """Sum of weights times colour."""
    opacity: Float[Tensor, "rays"]
    depth: Float[Tensor, "rays"]
    """Sum of weights times distance."""
    samples: int
    """That the field was evaluated at, in training; 0 in rendering."""


def has_kernel(
    field: FieldParts | None, matmul_precision: MatmulPrecision, device: torch.device, gradients: bool
) -> bool:
    """Return whether there is a kernel for a field.

    Args:
        field: None: of a kind that no kernel knows.
        matmul_precision: the precision of its products.
        device: of its parameters, and the rays.
        gradients: whether they are wanted, for the field's parameters alone.
    """
    module = LEARNING if gradients else RENDERING
    perceptrons = cpu_backend("mlp.cpu", device) if field is not None and is_on(module) else None
    if field is None or perceptrons is None or field.table.dtype != torch.float32:
        return False
    if not all(perceptrons.takes(each, _dtype(matmul_precision)) for each in field.weights):
        return False
    return cpu_backend(module, device) is not None


def render_whole_rays(
    rays: RayBundle,
    field: FieldParts,
    march: GridMarch,
    matmul_precision: MatmulPrecision,
    opaque_below: float,
    least_alpha: float,
    samples_per_ray: float | None,
) -> WholeRays:
    """Render rays with the kernel that `has_kernel` found.

    Args:
        rays: unit directions.
        field: table and weights.
        march: where each ray stands, and through what it goes.
        matmul_precision: the precision of the field's products.
        opaque_below: a ray ends where less light is left.
        least_alpha: in rendering, samples less opaque than this have no colour.
        samples_per_ray: how many are expected in training; None: render without gradients.
    """
    kernels: Any = cpu_backend(RENDERING if samples_per_ray is None else LEARNING, rays.near.device)
    if samples_per_ray is None:
        rgb, opacity, depth = kernels.render(rays, field, *march, least_alpha, opaque_below, _dtype(matmul_precision))
        return WholeRays(rgb, opacity, depth, samples=0)
    return WholeRays(*kernels.render(rays, field, *march, opaque_below, _dtype(matmul_precision), samples_per_ray))


def _dtype(matmul_precision: MatmulPrecision) -> torch.dtype:
    return torch.bfloat16 if matmul_precision == "bfloat16" else torch.float32

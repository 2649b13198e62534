"""Whole rays rendered in one kernel: the interface of these kernels, for any level that offers its rays.

On the CPU there are kernels for levels that march through an occupancy grid, and for those with the same number of
samples on every ray. On CUDA rays take several kernels, one after another (`render_samples`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import cpu_backend, cuda_backend, is_on
from nerf_lightning.nerf.kernels.hash_grid.layout import HashGridLayout
from nerf_lightning.nerf.kernels.march.grid import GridMarch
from nerf_lightning.nerf.kernels.ragged.op import Integrated
from nerf_lightning.nerf.matmul_precision import MatmulPrecision
from nerf_lightning.nerf.types.rays import RaggedSamples, RayBundle, RaySamples

LEARNING, RENDERING, DENSE, SAMPLES = "render.gradients", "render.cpu", "render.dense", "render.cuda"


@dataclass(frozen=True)
class FieldParts:
    """The parts of a field that the kernels compute with.

    A hash grid, and two MLPs without biases: density, and color from the density MLP's outputs.
    """

    aabb: Float[Tensor, "2 3"]
    """The box, outside of which space is empty. If space is contracted, the box whose inside is not contracted."""
    table: Float[Tensor, "entries features"]
    layout: HashGridLayout
    bias: float
    """Added to the raw density before the exponential."""
    density_weights: list[Tensor]
    color_weights: list[Tensor]
    """Weights of the color MLP; its inputs are the density MLP's outputs and what a ray's samples share. Empty: density
    only."""
    ray_features: Callable[[RayBundle], Float[Tensor, "rays features"]]
    """Returns what all samples of a ray share: the features of its direction, and a photograph's embedding."""
    least_slope: float = 0.0
    """Minimum slope of a color over its raw value on the way back from black or full, in training."""
    contracted: bool = False
    """Whether all space, contracted around the box, is mapped to the unit cube (`geometry.contraction`)."""
    ray_features_learn: bool = False
    """Whether `ray_features` has anything to learn."""

    def handed_over(self, shared: int) -> int:
        """Return how many outputs of the density are inputs of the colors, besides the `shared` ones of the ray."""
        return self.color_weights[0].shape[1] - shared if self.color_weights else 0

    @property
    def weights(self) -> tuple[list[Tensor], list[Tensor]]:
        """Weights of both MLPs."""
        return self.density_weights, self.color_weights


class WholeRays(NamedTuple):
    """What a kernel computed along each ray."""

    rgb: Float[Tensor, "rays 3"]
    """Sum of weights times color."""
    opacity: Float[Tensor, "rays"]
    depth: Float[Tensor, "rays"]
    """Sum of weights times distance."""
    samples: int
    """Number of samples at which the field was evaluated in training; 0 in rendering."""


def has_kernel(
    field: FieldParts | None, matmul_precision: MatmulPrecision, device: torch.device, gradients: bool
) -> bool:
    """Return whether there is a kernel for rays that march through a box.

    Args:
        field: the field's parts; None: no kernel supports it.
        matmul_precision: the precision of its products.
        device: device of its parameters and the rays.
        gradients: whether gradients are needed, for the field's table and weights only.
    """
    if field is None or field.contracted or (gradients and field.ray_features_learn):
        return False
    return _has(LEARNING if gradients else RENDERING, field, matmul_precision, device)


def has_dense_kernel(field: FieldParts | None, matmul_precision: MatmulPrecision, device: torch.device) -> bool:
    """Return whether there is a kernel for rays with equal numbers of samples; it has gradients for all that may learn.

    The arguments are those of `has_kernel`.
    """
    return field is not None and _has(DENSE, field, matmul_precision, device)


def render_samples(
    rays: RayBundle,
    samples: RaggedSamples | RaySamples,
    field: FieldParts | None,
    matmul_precision: MatmulPrecision,
    closed: bool = False,
    whole_from: float = 0.0,
    features: Float[Tensor, "samples features"] | None = None,
) -> Integrated | None:
    """Return the integrals along rays by CUDA kernels, which have gradients for the field's table and weights.

    None if there are no such kernels, or other gradients are needed. `features` are those of the field's grid at the
    samples, if already computed. The other arguments are those of `render_dense_rays`.
    """
    if field is None or not takes_samples(rays, field):
        return None
    kernels: Any = cuda_backend(SAMPLES, rays.near.device)
    return kernels.render(rays, samples, field, matmul_precision, closed, whole_from, features)


def sample_density(
    rays: RayBundle, samples: RaggedSamples, field: FieldParts | None, matmul_precision: MatmulPrecision
) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples features"]] | None:
    """Return the density and the features of the field's grid at samples, without gradients.

    None if `render_samples` would return None.
    """
    if field is None or not takes_samples(rays, field):
        return None
    kernels: Any = cuda_backend(SAMPLES, rays.near.device)
    return kernels.density(rays, samples, field, matmul_precision)


def takes_samples(rays: RayBundle, field: FieldParts | None) -> bool:
    """Return whether `render_samples` supports these rays."""
    if field is None or field.ray_features_learn or rays.near.dim() != 1:
        return False
    numbers = (rays.origins, rays.directions, field.table, *field.density_weights, *field.color_weights)
    if any(each.dtype != torch.float32 for each in numbers) or any(each.requires_grad for each in numbers[:2]):
        return False
    return cuda_backend(SAMPLES, rays.near.device) is not None


def _has(module: str, field: FieldParts, matmul_precision: MatmulPrecision, device: torch.device) -> bool:
    perceptrons = cpu_backend("mlp.cpu", device) if is_on(module) else None
    numbers = (field.table, *field.density_weights, *field.color_weights)
    if perceptrons is None or any(each.dtype != torch.float32 for each in numbers):
        return False
    if not all(perceptrons.takes(each, _dtype(matmul_precision), pads=True) for each in field.weights if each):
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
        march: each ray's state, and the grid it goes through.
        matmul_precision: the precision of the field's products.
        opaque_below: a ray ends where its transmittance falls below this.
        least_alpha: in rendering, samples less opaque than this have no color.
        samples_per_ray: number expected in training; None: render without gradients.
    """
    kernels: Any = cpu_backend(RENDERING if samples_per_ray is None else LEARNING, rays.near.device)
    if samples_per_ray is None:
        rgb, opacity, depth = kernels.render(rays, field, *march, least_alpha, opaque_below, _dtype(matmul_precision))
        return WholeRays(rgb, opacity, depth, samples=0)
    return WholeRays(*kernels.render(rays, field, *march, opaque_below, _dtype(matmul_precision), samples_per_ray))


def render_dense_rays(
    rays: RayBundle,
    edges: Float[Tensor, "rays edges"],
    field: FieldParts,
    matmul_precision: MatmulPrecision,
    closed: bool,
    whole_from: float,
    opaque_below: float,
) -> tuple[Float[Tensor, "rays samples"], Float[Tensor, "rays 3"]]:
    """Render rays with the kernel that `has_dense_kernel` found; return all weights, and sums of weights times color.

    Args:
        rays: unit directions.
        edges: the intervals, at whose midpoints the field is evaluated.
        field: table and weights.
        matmul_precision: the precision of the field's products.
        closed: whether the last interval absorbs all remaining light.
        whole_from: gradients of samples nearer than this are scaled down (`rendering.near_gradients`); 0: of none.
        opaque_below: a sample behind which less light is left absorbs it all, and ends its ray; 0: none does.
    """
    kernels: Any = cpu_backend(DENSE, rays.near.device)
    return kernels.render(rays, edges, field, _dtype(matmul_precision), closed, whole_from, opaque_below)


def _dtype(matmul_precision: MatmulPrecision) -> torch.dtype:
    return torch.bfloat16 if matmul_precision == "bfloat16" else torch.float32

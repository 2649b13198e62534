"""Volume rendering of ragged samples, and where rays become opaque.

Letters as in `rendering.quadrature`. With g_j the derivative of the loss by w_j, that by the density is delta_i
(T_{i+1} g_i - sum_{j>i} w_j g_j).
"""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import backend_for, cuda_backend
from nerf_lightning.nerf.kernels.ragged.reference import (
    first_of_each_ray_torch,
    integrate_torch,
    transmittance_torch,
)
from nerf_lightning.nerf.types.rays import RaggedSamples

Integrated = tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"], Float[Tensor, "rays"], Float[Tensor, "*samples"]]
"""Per ray, sum of w rgb, sum of w, sum of w t; and the weights w."""


def integrate(
    density: Float[Tensor, "capacity"], rgb: Float[Tensor, "capacity 3"], samples: RaggedSamples
) -> Integrated:
    """Return, per ray, sum of w rgb, sum of w, sum of w t, and the weights w."""
    backend = backend_for("ragged", density.device)
    if backend is None or density.dtype != torch.float32 or rgb.dtype != torch.float32:
        return integrate_torch(density, rgb, samples)
    return _Integrate.apply(density, rgb, samples.starts, samples.ends, samples.bounds, backend)


def integrate_dense(
    density: Float[Tensor, "*rays samples"],
    rgb: Float[Tensor, "*rays samples 3"],
    edges: Float[Tensor, "*rays edges"],
    closed: bool,
) -> Integrated | None:
    """Return the same for rays with the same number of samples; None if there is no kernel for it.

    Args:
        density: per unit length.
        rgb: in [0, 1].
        edges: fenceposts of the intervals.
        closed: whether the last sample absorbs all remaining light.
    """
    single = all(each.dtype == torch.float32 for each in (density, rgb, edges))
    backend = cuda_backend("ragged.cuda", density.device) if single and not edges.requires_grad else None
    if backend is None:
        return None
    shape, fenceposts = density.shape[:-1], edges.contiguous().flatten()
    given = density.flatten(), rgb.flatten(0, -2), fenceposts, fenceposts[1:], fenceposts
    foreground, opacity, depth, weights = _Integrate.apply(*given, backend, density.shape[-1], closed)
    return foreground.view(*shape, 3), opacity.view(shape), depth.view(shape), weights.view_as(density)


def num_visible(density: Float[Tensor, "capacity"], samples: RaggedSamples, opaque_below: float) -> Int[Tensor, "rays"]:
    """Return how many samples of each ray begin where the transmittance exceeds `opaque_below`."""
    backend = backend_for("ragged", density.device)
    if backend is not None and density.dtype == torch.float32:
        return backend.num_visible(density, samples, opaque_below)
    counts = torch.zeros_like(samples.bounds[1:])
    padding = torch.arange(density.shape[0], device=density.device) < samples.bounds[-1]
    seen = (transmittance_torch(density, samples) > opaque_below) & padding
    return counts.index_add(0, samples.ray_index, seen.to(counts.dtype))


def first_of_each_ray(
    samples: RaggedSamples,
    counts: Int[Tensor, "rays"],
    features: Float[Tensor, "capacity features"] | None = None,
    capacity: int | None = None,
) -> tuple[RaggedSamples, Float[Tensor, "kept features"] | None]:
    """Return the first `counts` samples of each ray, and their features, without gradients.

    `found` then counts these and the samples that had been dropped before, whose visibility is unknown.

    Args:
        samples: all of them.
        counts: number of samples kept of each ray.
        features: features of all samples, if there are any; padding gets zeros.
        capacity: size of the returned arrays, so that no size is read on the host; what does not fit is dropped from
            the last rays. None: as many as there are.
    """
    backend = cuda_backend("ragged.cuda", counts.device)
    if backend is not None and capacity is not None:
        return backend.first_of_each_ray(samples, counts, features, capacity)
    return first_of_each_ray_torch(samples, counts, features, capacity)


class _Integrate(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        density: Tensor,
        rgb: Tensor,
        starts: Tensor,
        ends: Tensor,
        bounds: Tensor,
        backend: Any,
        *dense: int,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        density, rgb = density.contiguous(), rgb.contiguous()
        foreground, opacity, depth, weights = backend.integrate(density, rgb, starts, ends, bounds, *dense)
        ctx.save_for_backward(density, rgb, starts, ends, bounds, weights)
        ctx.backend, ctx.dense = backend, dense
        return foreground, opacity, depth, weights

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, foreground: Tensor, opacity: Tensor, depth: Tensor, weights: Tensor) -> tuple[Any, ...]:
        grads = (foreground, opacity, depth, weights)
        density, rgb = ctx.backend.integrate_gradient(
            *ctx.saved_tensors, *(grad.contiguous() for grad in grads), *ctx.dense
        )
        return density, rgb, *[None] * (len(ctx.needs_input_grad) - 2)

"""Volume rendering of ragged samples, and where rays become opaque.

Letters as in `rendering.quadrature`. With g_j the loss's derivative by w_j, that by density is
delta_i (T_{i+1} g_i - sum_{j>i} w_j g_j).
"""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import cpu_backend
from nerf_lightning.nerf.kernels.ragged.reference import integrate_torch, transmittance_torch
from nerf_lightning.nerf.types.rays import RaggedSamples


def integrate(
    density: Float[Tensor, "capacity"], rgb: Float[Tensor, "capacity 3"], samples: RaggedSamples
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"], Float[Tensor, "rays"], Float[Tensor, "capacity"]]:
    """Return, per ray, sum of w rgb, sum of w, sum of w t, and the weights w."""
    backend = cpu_backend("ragged.cpu", density.device)
    if backend is None or density.dtype != torch.float32 or rgb.dtype != torch.float32:
        return integrate_torch(density, rgb, samples)
    return _Integrate.apply(density, rgb, samples.starts, samples.ends, samples.bounds, backend)


def num_visible(density: Float[Tensor, "capacity"], samples: RaggedSamples, opaque_below: float) -> Int[Tensor, "rays"]:
    """Return how many samples of each ray begin where more than `opaque_below` of the light is left."""
    backend = cpu_backend("ragged.cpu", density.device)
    if backend is not None and density.dtype == torch.float32:
        return backend.num_visible(density, samples, opaque_below)
    counts = torch.zeros_like(samples.bounds[1:])
    padding = torch.arange(density.shape[0], device=density.device) < samples.bounds[-1]
    seen = (transmittance_torch(density, samples) > opaque_below) & padding
    return counts.index_add(0, samples.ray_index, seen.to(counts.dtype))


class _Integrate(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, density: Tensor, rgb: Tensor, starts: Tensor, ends: Tensor, bounds: Tensor, backend: Any
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        density, rgb = density.contiguous(), rgb.contiguous()
        foreground, opacity, depth, weights = backend.integrate(density, rgb, starts, ends, bounds)
        ctx.save_for_backward(density, rgb, starts, ends, bounds, weights)
        ctx.backend = backend
        return foreground, opacity, depth, weights

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, foreground: Tensor, opacity: Tensor, depth: Tensor, weights: Tensor) -> tuple[Any, ...]:
        grads = (foreground, opacity, depth, weights)
        density, rgb = ctx.backend.integrate_gradient(*ctx.saved_tensors, *(grad.contiguous() for grad in grads))
        return density, rgb, None, None, None, None

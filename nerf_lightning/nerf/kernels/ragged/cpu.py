"""Rendering of ragged samples for the CPU: one loop over the samples of each ray, forward and backward."""

import math
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import njit
from torch import Tensor

from nerf_lightning.nerf.kernels.threads import over_rows
from nerf_lightning.nerf.types.rays import RaggedSamples


def integrate(
    density: Float[Tensor, "n"],
    rgb: Float[Tensor, "n 3"],
    starts: Float[Tensor, "n"],
    ends: Float[Tensor, "n"],
    bounds: Int[Tensor, "bounds"],
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"], Float[Tensor, "rays"], Float[Tensor, "n"]]:
    """Return foreground, opacity, depth and weights."""
    rays = bounds.shape[0] - 1
    out = torch.empty(rays, 3), torch.empty(rays), torch.empty(rays), torch.zeros_like(density)
    over_rows(_integrate, rays, *(x.detach().numpy() for x in (density, rgb, starts, ends, bounds, *out)))
    return out


def integrate_gradient(
    density: Float[Tensor, "n"],
    rgb: Float[Tensor, "n 3"],
    starts: Float[Tensor, "n"],
    ends: Float[Tensor, "n"],
    bounds: Int[Tensor, "bounds"],
    weights: Float[Tensor, "n"],
    *grads: Tensor,
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"]]:
    """Return the gradients of density and color, given those of foreground, opacity, depth and weights."""
    out = torch.zeros_like(density), torch.zeros_like(rgb)
    over_rows(
        _gradient,
        bounds.shape[0] - 1,
        *(x.detach().numpy() for x in (density, rgb, starts, ends, bounds, weights, *grads, *out)),
    )
    return out


def num_visible(density: Float[Tensor, "n"], samples: RaggedSamples, opaque_below: float) -> Int[Tensor, "rays"]:
    """Return how many samples of each ray begin where the transmittance exceeds `opaque_below`."""
    out = torch.empty_like(samples.bounds[1:])
    arrays = (density.detach().contiguous(), samples.starts, samples.ends, samples.bounds, out)
    most = np.float32(-math.log(opaque_below))
    over_rows(_num_visible, out.shape[0], most, *(x.numpy() for x in arrays))
    return out


def trial() -> None:
    """Run every kernel once on tiny input; it raises whatever the compiler raises."""
    bounds, along = torch.tensor([0, 2]), torch.arange(2.0)
    samples = RaggedSamples(torch.zeros(2, dtype=torch.long), along, along + 1.0, bounds, bounds[-1])
    density, rgb = torch.ones(2), torch.ones(2, 3)
    foreground, opacity, depth, weights = integrate(density, rgb, samples.starts, samples.ends, bounds)
    grads = (foreground, opacity, depth, weights)
    integrate_gradient(density, rgb, samples.starts, samples.ends, bounds, weights, *grads)
    num_visible(density, samples, 0.01)


@njit(nogil=True, cache=True)
@no_type_check
def _integrate(first, last, density, rgb, starts, ends, bounds, foreground, opacity, depth, weights):
    for r in range(first, last):
        optical = red = green = blue = total = distance = np.float32(0.0)
        for i in range(bounds[r], bounds[r + 1]):
            thickness = density[i] * (ends[i] - starts[i])
            w = math.exp(-optical) * -math.expm1(-thickness)
            optical += thickness
            weights[i] = w
            red += w * rgb[i, 0]
            green += w * rgb[i, 1]
            blue += w * rgb[i, 2]
            total += w
            distance += w * np.float32(0.5) * (starts[i] + ends[i])
        foreground[r, 0], foreground[r, 1], foreground[r, 2] = red, green, blue
        opacity[r], depth[r] = total, distance


@njit(nogil=True, cache=True)
@no_type_check
def _gradient(
    first, last, density, rgb, starts, ends, bounds, weights, d_light, d_opacity, d_depth, d_weights, d_density, d_rgb
):
    for r in range(first, last):
        optical = np.float32(0.0)
        for i in range(bounds[r], bounds[r + 1]):
            optical += density[i] * (ends[i] - starts[i])
            d_density[i] = math.exp(-optical)  # kept for the reverse loop: T_{i+1}
        behind = np.float32(0.0)
        for i in range(bounds[r + 1] - 1, bounds[r] - 1, -1):
            w, delta = weights[i], ends[i] - starts[i]
            g = d_opacity[r] + d_depth[r] * np.float32(0.5) * (starts[i] + ends[i]) + d_weights[i]
            for c in range(3):
                g += d_light[r, c] * rgb[i, c]
                d_rgb[i, c] = d_light[r, c] * w
            d_density[i] = delta * (d_density[i] * g - behind)
            behind += w * g


@njit(nogil=True, cache=True)
@no_type_check
def _num_visible(first, last, most, density, starts, ends, bounds, out):
    for r in range(first, last):
        optical = np.float32(0.0)
        i = bounds[r]
        while i < bounds[r + 1] and optical < most:
            optical += density[i] * (ends[i] - starts[i])
            i += 1
        out[r] = i - bounds[r]

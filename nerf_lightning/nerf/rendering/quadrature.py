"""Volume rendering by quadrature: density -> alpha -> transmittance -> weights -> pixel (arXiv 2003.08934, Eq. 3).

Letters: sigma_i density of interval i, delta_i its length, alpha_i = 1 - exp(-sigma_i delta_i) what it absorbs,
T_i = exp(-sum_{j<i} sigma_j delta_j) the light that reaches its start, w_i = T_i alpha_i. Samples are the last axis.
Light that escapes, and its depth: `Rendering.from_sums` in `nerf/types/renderings.py`.
The kernels in `kernels/ragged` and `kernels/render` compute the same, and must change with it.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.kernels.ragged.op import integrate, integrate_dense
from nerf_lightning.nerf.types.rays import RaggedSamples, RayBundle, RaySamples
from nerf_lightning.nerf.types.renderings import DenseRendering, FieldOutput, RaggedRendering


def weights_from_density(
    density: Float[Tensor, "*rays samples"], deltas: Float[Tensor, "*rays samples"]
) -> Float[Tensor, "*rays samples"]:
    """Return the probability that a ray ends in each interval (Eq. 3, arXiv 2003.08934).

    `expm1` keeps thin intervals exact, where 1 - exp(-x) would lose all digits. Gradients stay finite for any
    density: transmittance is the exponential of a sum, never a product with an epsilon.

    >>> ln2 = torch.log(torch.tensor(2.0))
    >>> weights_from_density(torch.stack([ln2, ln2, ln2]), torch.ones(3))
    tensor([0.5000, 0.2500, 0.1250])
    """
    optical = density * deltas
    before = torch.cat([torch.zeros_like(optical[..., :1]), optical[..., :-1].cumsum(dim=-1)], dim=-1)
    return torch.exp(-before) * -torch.expm1(-optical)


def closed_weights(weights: Float[Tensor, "*rays samples"]) -> Float[Tensor, "*rays samples"]:
    """Let the last interval absorb all remaining light, for scenes without a background.

    >>> closed_weights(torch.tensor([0.5, 0.25, 0.125]))
    tensor([0.5000, 0.2500, 0.2500])
    """
    first = weights[..., :-1]
    return torch.cat([first, (1.0 - first.sum(dim=-1, keepdim=True)).clamp(min=0.0)], dim=-1)


def composite(
    output: FieldOutput,
    samples: RaySamples,
    rays: RayBundle,
    background: Float[Tensor, "*rays 3"] | None,
) -> DenseRendering:
    """Render one level. Light that escapes belongs to `background` and, in the depth, to far.

    Args:
        output: density and color at the samples' midpoints.
        samples: the intervals.
        rays: the rays, with near and far.
        background: color behind each ray; None closes the ray instead.
    """
    closed = background is None
    integrated = None if output.channels else integrate_dense(output.density, output.rgb, samples.edges, closed)
    if integrated is not None:
        *sums, weights = integrated
        return DenseRendering.from_sums(rays, background, *sums, weights=weights, samples=samples)
    weights = weights_from_density(output.density, samples.deltas)
    if closed:
        weights = closed_weights(weights)
    foreground = (weights[..., None] * output.rgb).sum(dim=-2)
    channels = {name: (weights[..., None] * each).sum(dim=-2) for name, each in output.channels.items()}
    return rendering_of(weights, foreground, samples, rays, background, channels)


def rendering_of(
    weights: Float[Tensor, "*rays samples"],
    foreground: Float[Tensor, "*rays 3"],
    samples: RaySamples,
    rays: RayBundle,
    background: Float[Tensor, "*#rays 3"] | None,
    channels: dict[str, Tensor] | None = None,
) -> DenseRendering:
    """Return the rendering, given the weights and the sum of w rgb; the other arguments are those of `composite`."""
    opacity, depth = weights.sum(dim=-1), (weights * samples.midpoints).sum(dim=-1)
    of_the_kind = {"weights": weights, "samples": samples, "channels": channels or {}}
    return DenseRendering.from_sums(rays, background, foreground, opacity, depth, **of_the_kind)


def composite_ragged(
    output: FieldOutput,
    samples: RaggedSamples,
    rays: RayBundle,
    background: Float[Tensor, "rays 3"] | None,
) -> RaggedRendering:
    """Render one level. Light that escapes belongs to `background` and, in the depth, to far.

    Args:
        output: density and color at the samples' midpoints.
        samples: the intervals.
        rays: the rays, with far.
        background: color behind each ray; None leaves the rays open in front of black.
    """
    *sums, weights = integrate(output.density, output.rgb, samples)
    channels = {name: sum_over_rays(weights[:, None] * each, samples) for name, each in output.channels.items()}
    of_the_kind: dict[str, Any] = {"weights": weights, "samples": samples, "channels": channels}
    return RaggedRendering.from_sums(rays, background, *sums, **of_the_kind)


def sum_over_rays(values: Float[Tensor, "capacity n"], samples: RaggedSamples) -> Float[Tensor, "rays n"]:
    """Return the sum of each ray's values."""
    total = values.new_zeros(samples.bounds.shape[0] - 1, values.shape[1])
    return total.index_add(0, samples.ray_index, values)

"""Statistics of the weights along rays: where a level sees something, and on how many samples its picture rests."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.nerf.geometry.contraction import normalized_distance
from nerf_lightning.nerf.types.rays import RayBundle
from nerf_lightning.nerf.types.renderings import DenseRendering, RaggedRendering


def effective_samples(rendering: DenseRendering | RaggedRendering, rays: RayBundle) -> Float[Tensor, "rays"]:
    """Return on how many samples each ray's light rests: (sum of weights)^2 / (sum of their squares), Kish's measure.

    It is 1 if one sample has all the weight, the number of samples if all weights are equal, and 0 if all are 0.
    """
    ray, _, weights = _samples_of(rendering)
    sums = torch.zeros(2, rays.near.numel(), device=weights.device)
    sums.index_add_(1, ray, torch.stack([weights, weights.square()]))
    return sums[0].square() / sums[1].clamp(min=torch.finfo(sums.dtype).tiny)


def weight_along(
    rendering: DenseRendering | RaggedRendering, rays: RayBundle, bins: int, contracted_spacing: bool = False
) -> Float[Tensor, "bins"]:
    """Return how much weight is in each of `bins` equal parts of the way from near to far, as a mean over rays.

    Args:
        rendering: what a level saw.
        rays: the rays.
        bins: number of parts.
        contracted_spacing: whether the parts are equal in the spacing of unbounded space (`geometry.contraction`).
    """
    ray, distance, weights = _samples_of(rendering)
    near, far = rays.near.reshape(-1), rays.far.reshape(-1)
    if contracted_spacing:
        near, far, distance = normalized_distance(near), normalized_distance(far), normalized_distance(distance)
    share = (distance - near[ray]) / (far - near).clamp(min=torch.finfo(torch.float32).tiny)[ray]
    bin_index = (bins * share).long().clamp(0, bins - 1)
    total = torch.zeros(bins, device=weights.device).index_add_(0, bin_index, weights)
    return total / rays.near.numel()


def median_distances(rendering: DenseRendering | RaggedRendering, rays: RayBundle) -> Float[Tensor, "rays"]:
    """Return the distance at which each ray has accumulated half of its weight; far, if it has none.

    Unlike the expected distance, it is in what the ray sees, not between the haze in front of a surface and the
    surface.
    """
    ray, distance, weights = _samples_of(rendering)
    ends = weights.double().cumsum(0)  # over all rays, so float32 would lose a ray's own
    total = torch.zeros(rays.near.numel(), dtype=ends.dtype, device=ends.device).index_add_(0, ray, weights.double())
    half = (total.cumsum(0) - 0.5 * total)[ray]
    crossed = (ends >= half) & (ends - weights < half)
    median = rays.far.reshape(-1).clone()
    median[ray[crossed]] = distance[crossed].to(median)
    return median


def transmittance_at(
    rendering: DenseRendering | RaggedRendering, rays: RayBundle, distance: Float[Tensor, "rays"]
) -> Float[Tensor, "rays"]:
    """Return the transmittance of each ray at a distance."""
    ray, midpoint, weights = _samples_of(rendering)
    before = torch.where(midpoint < distance.reshape(-1)[ray], weights, 0.0)
    stopped = torch.zeros(rays.near.numel(), device=weights.device).index_add_(0, ray, before)
    return (1.0 - stopped).clamp(min=0.0)


def _samples_of(
    rendering: DenseRendering | RaggedRendering,
) -> tuple[Int[Tensor, "samples"], Float[Tensor, "samples"], Float[Tensor, "samples"]]:
    """Return each sample's ray, distance and weight."""
    samples, weights = rendering.samples, rendering.weights.float().reshape(-1)
    if isinstance(rendering, RaggedRendering):
        return rendering.samples.ray_index, samples.midpoints.float(), weights
    per_ray = rendering.weights.shape[-1]
    ray = torch.arange(weights.numel(), device=weights.device) // per_ray
    return ray, samples.midpoints.float().reshape(-1), weights

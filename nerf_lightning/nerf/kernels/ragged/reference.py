"""Rendering of ragged samples in plain torch: the reference, and the fallback without kernels."""

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from nerf_lightning.nerf.types.rays import RaggedSamples


def transmittance_torch(density: Float[Tensor, "capacity"], samples: RaggedSamples) -> Float[Tensor, "capacity"]:
    """Return the light that reaches the start of each interval."""
    # One row of a table per ray: separate sums are exact in float32, and no two samples share a cell, so gradients need
    # not wait. Padding has its own rows.
    rays, capacity = samples.bounds.shape[0] - 1, density.shape[0]
    longest = int(samples.bounds.diff().amax()) if samples.longest is None and rays else samples.longest
    columns = max(1, longest or 0)
    slot = torch.arange(capacity, device=density.device)
    in_ray = samples.ray_index * columns + samples.sample_index
    cell = torch.where(slot < samples.bounds[-1], in_ray, rays * columns + slot)
    optical = density * samples.deltas
    table = optical.new_zeros((rays + -(-capacity // columns)) * columns).scatter(0, cell, optical).view(-1, columns)
    optical_depth = functional.pad(table[:, :-1], (1, 0)).cumsum(dim=-1)
    return torch.exp(-optical_depth.flatten().gather(0, cell)).to(density.dtype)


def integrate_torch(
    density: Float[Tensor, "capacity"], rgb: Float[Tensor, "capacity 3"], samples: RaggedSamples
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"], Float[Tensor, "rays"], Float[Tensor, "capacity"]]:
    """Return, per ray, sum of w rgb, sum of w, sum of w t, and the weights w."""
    alpha = -torch.expm1(-density * samples.deltas)
    weights = transmittance_torch(density, samples) * alpha
    num_rays = samples.bounds.shape[0] - 1
    columns = torch.cat([weights[:, None] * rgb, weights[:, None], (weights * samples.midpoints)[:, None]], dim=-1)
    sums = columns.new_zeros(num_rays, 5).index_add(0, samples.ray_index, columns)
    return sums[:, :3], sums[:, 3], sums[:, 4], weights


def first_of_each_ray_torch(
    samples: RaggedSamples,
    counts: Int[Tensor, "rays"],
    features: Float[Tensor, "capacity features"] | None,
    capacity: int | None,
) -> tuple[RaggedSamples, Float[Tensor, "kept features"] | None]:
    """Return the first `counts` samples of each ray, and their features."""
    keep = samples.sample_index < counts.index_select(0, samples.ray_index)
    bounds = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    found = bounds[-1] + samples.found - samples.bounds[-1]
    kept = keep.nonzero() if capacity is None else torch.nonzero_static(keep, size=capacity, fill_value=0)
    left = replace(samples.at(kept[:, 0], bounds), found=found)
    of_left = None if features is None else features.index_select(0, kept[:, 0])
    if capacity is None:
        return left, of_left
    bounds, slot = bounds.clamp(max=capacity), torch.arange(capacity, device=counts.device)
    filled = slot < bounds[-1]
    ray = torch.where(filled, left.ray_index, slot % max(1, counts.shape[0]))
    left = replace(left, ray_index=ray, starts=left.starts * filled, ends=left.ends * filled, bounds=bounds)
    return left, None if of_left is None else of_left * filled[:, None]

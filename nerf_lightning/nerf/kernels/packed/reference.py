"""Rendering of packed samples in plain torch: the reference, and what runs on GPUs."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.types.rays import PackedSamples


def transmittance_torch(density: Float[Tensor, "capacity"], samples: PackedSamples) -> Float[Tensor, "capacity"]:
    """Return the light that reaches the start of each interval."""
    # One sum over all rays, less what the earlier rays added: only float64 keeps the small difference.
    optical = (density * samples.deltas).double()
    before = torch.cat([optical.new_zeros(1), optical.cumsum(0)])
    at_ray = before[samples.bounds[:-1]]
    return torch.exp(at_ray[samples.ray_index] - before[:-1]).to(density.dtype)


def integrate_torch(
    density: Float[Tensor, "capacity"], rgb: Float[Tensor, "capacity 3"], samples: PackedSamples
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"], Float[Tensor, "rays"], Float[Tensor, "capacity"]]:
    """Return, per ray, sum of w rgb, sum of w, sum of w t, and the weights w."""
    alpha = -torch.expm1(-density * samples.deltas)
    weights = transmittance_torch(density, samples) * alpha
    num_rays = samples.bounds.shape[0] - 1
    columns = torch.cat([weights[:, None] * rgb, weights[:, None], (weights * samples.midpoints)[:, None]], dim=-1)
    sums = columns.new_zeros(num_rays, 5).index_add(0, samples.ray_index, columns)
    return sums[:, :3], sums[:, 3], sums[:, 4], weights

"""The hash grid in plain torch: the reference, for any device and dtype."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.nerf.kernels.hash_grid.layout import PRIME_Y, PRIME_Z, HashGridLayout


def interpolate_torch(
    table: Float[Tensor, "entries features"], points: Float[Tensor, "points 3"], layout: HashGridLayout
) -> Float[Tensor, "points out"]:
    """Return the trilinear features of points in the unit cube, level by level."""
    number = torch.arange(8, device=points.device)
    corners = torch.stack([number & 1, number >> 1 & 1, number >> 2], dim=-1)
    features = []
    for level, resolution in enumerate(layout.resolutions):
        scaled = points.clamp(0.0, 1.0) * resolution
        cell = scaled.detach().long().clamp(max=resolution - 1)
        part = (scaled - cell)[:, None, :]
        weights = torch.where(corners == 1, part, 1.0 - part).prod(dim=-1)
        entries = table[_entries(cell[:, None, :] + corners, level, layout)]
        features.append((weights[..., None].to(table.dtype) * entries).sum(dim=1))
    return torch.cat(features, dim=-1)


def _entries(vertex: Int[Tensor, "points 8 3"], level: int, layout: HashGridLayout) -> Int[Tensor, "points 8"]:
    x, y, z = vertex.unbind(-1)
    if layout.is_hashed(level):
        # Products of at most 2^32 and a few thousand stay below 2^63.
        index = (x ^ (y * PRIME_Y) ^ (z * PRIME_Z)) & (layout.table_size - 1)
    else:
        side = layout.resolutions[level] + 1
        index = x + side * (y + side * z)
    return index + layout.offsets[level]

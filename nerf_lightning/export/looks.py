"""Along which directions points are looked at: from the cameras that stand nearest, or that face them most squarely."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nerf_lightning.models.tiles import tiles

# Cameras that are taken of each point.
NEAREST = 3
# The ways of all points to all cameras would take gigabytes: so many are held at a time, of 36 bytes.
PAIRS = 1 << 20


def looks_from_nearest(
    points: Float[Tensor, "points 3"], eyes: Float[Tensor, "cameras 3"]
) -> Float[Tensor, "looks points 3"]:
    """Return unit directions to each point from the cameras that stand nearest to it."""
    parts = []
    for part in _handy(points, eyes):
        away = points[part, None] - eyes
        parts.append(_chosen(away, -away.norm(dim=-1)))
    return functional.normalize(torch.cat(parts, dim=1), dim=-1)


def looks_from_facing(
    points: Float[Tensor, "points 3"], normals: Float[Tensor, "points 3"], eyes: Float[Tensor, "cameras 3"]
) -> Float[Tensor, "looks points 3"]:
    """Return unit directions to each point from the cameras that its unit normal points at most squarely."""
    parts = []
    for part in _handy(points, eyes):
        away = functional.normalize(points[part, None] - eyes, dim=-1)
        parts.append(_chosen(away, -(away * normals[part, None]).sum(dim=-1)))
    return torch.cat(parts, dim=1)


def _handy(points: Tensor, eyes: Tensor) -> list[slice]:
    return list(tiles(len(points), max(1, PAIRS // len(eyes))))


def _chosen(away: Float[Tensor, "points cameras 3"], score: Float[Tensor, "points cameras"]) -> Tensor:
    best = score.topk(min(NEAREST, away.shape[1]), dim=-1).indices
    return torch.stack([away[torch.arange(len(away)), each] for each in best.T])

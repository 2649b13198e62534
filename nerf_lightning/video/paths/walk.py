"""A walk past the photographs, for captures without a single subject: rooms, streets, terraces."""

from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.nerf.matmul_precision import disable_autocast
from nerf_lightning.nerf.types.scene import Cameras
from nerf_lightning.video.paths.base import CameraPath, PathFrame, check_setting
from nerf_lightning.video.paths.spline import even_speed, frame_times, poses_along

STEEP = 0.94
"""Cosine to the vertical (20 degrees) beyond which level pictures would spin."""
DETOUR = 1.5
"""Maximum length of the path in the capture's order, in multiples of that from neighbor to neighbor."""


@final
@dataclass
class Walk(CameraPath):
    """Go from photograph to photograph, smoothed and level, looking where they look.

    The order is the capture's, or from neighbor to neighbor if that is much shorter, as for pictures by many people.

    Args:
        smooth: number of photographs over which places and directions are averaged (standard deviation).
    """

    smooth: float = 0.7

    def __post_init__(self) -> None:
        super().__post_init__()
        check_setting("smooth", self.smooth, 0 < self.smooth <= 100, "a number of photographs above 0, at most 100")

    @disable_autocast
    def cameras(self, around: PathFrame) -> Cameras:
        """Return the cameras of the walk, from the first photograph to the last one."""
        keys = around.poses[walking_order(around.poses, around.radius)]
        if len(keys) > 1:
            number = torch.arange(len(keys)).to(keys)
            weights = torch.softmax(-0.5 * ((number[:, None] - number) / self.smooth).square(), dim=-1)
            smoothed = torch.einsum("kj,jab->kab", weights, keys)
            keys = level(smoothed[:, :, 3], -smoothed[:, :, 2], keys[:, :, 1], around.up)
            knots = even_speed(keys, around.radius, closed=False)
            keys = poses_along(knots, keys, frame_times(knots, self.num_frames, closed=False))
        else:
            keys = keys.expand(self.num_frames, -1, -1)
        return self.pinholes(level(keys[:, :, 3], -keys[:, :, 2], keys[:, :, 1], around.up), around)


@disable_autocast
def level(
    eyes: Float[Tensor, "keys 3"],
    ahead: Float[Tensor, "keys 3"],
    own_up: Float[Tensor, "keys 3"],
    up: Float[Tensor, "3"],
) -> Float[Tensor, "keys 3 4"]:
    """Return cameras that look `ahead` with level horizons; those that look up or down steeply keep their own up."""
    up, ahead = normalize(up, dim=0), normalize(ahead, dim=-1)
    steep = ((ahead @ up).abs() > STEEP)[:, None]
    level_ones = look_at(eyes, eyes + ahead, up)
    others = torch.stack([look_at(eye, eye + to, own) for eye, to, own in zip(eyes, ahead, own_up, strict=True)])
    return torch.where(steep[..., None], others, level_ones)


@disable_autocast
def walking_order(poses: Float[Tensor, "views 3 4"], radius: float) -> Int[Tensor, "views"]:
    """Return the order in which to pass photographs: as given, or from neighbor to neighbor.

    The distance of two is their distance over `radius` plus the angle between their directions.
    """
    places, ahead = poses[:, :, 3] / max(radius, 1e-9), -poses[:, :, 2]
    apart = torch.cdist(places, places) + (ahead @ ahead.mT).clamp(-1.0, 1.0).acos()
    given = torch.arange(len(poses))
    left, order = apart.clone(), [0]
    for _ in range(len(poses) - 1):
        left[:, order[-1]] = torch.inf
        order.append(int(left[order[-1]].argmin()))
    nearest = torch.tensor(order)
    lengths = [float(apart[way[:-1], way[1:]].sum()) for way in (given, nearest)]
    return given if lengths[0] <= DETOUR * lengths[1] else nearest

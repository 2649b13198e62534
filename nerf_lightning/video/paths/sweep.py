"""A loop along the photographs' positions, upright, with what they show in the middle."""

import math
from dataclasses import dataclass, replace
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.nerf.geometry.world_frame import gaps_around
from nerf_lightning.nerf.matmul_precision import disable_autocast
from nerf_lightning.nerf.types.scene import Cameras
from nerf_lightning.video.paths.base import CameraPath, PathFrame, check_setting, level_axes

CROSSED_BY_A_CIRCLE, CROSSED, TIMES_THE_USUAL = 75.0, 25.0, 3.0
"""Maximum gap in degrees between neighboring photographs, seen from above, that a path may cross: the second, or the
third times the median if that is larger; for a circle, at most the first."""
OF_AN_ARC = 0.9  # Share that a path to and fro covers: at the ends few photographs see the same.
NEAREST, FARTHEST = 0.1, 0.9
"""Quantiles of the photographs' distances: nearer, content leaves the picture; farther, the view shows what no
photograph does."""
STRAY = 3.0  # Times the median distance: a photograph beyond it is considered a reconstruction error.
HIGHEST = 80.0  # Degrees: straight above the content a picture has no up.
MIDDLE, FRAMED = 2 / 3, 0.95
"""Share of the picture's width and height, and share of the content that every frame shows there."""
EASED = 12  # Steps back are averaged over a twelfth of the loop.


@final
@dataclass
class Sweep(CameraPath):
    """Go along the photographs and back to the start, looking at what they show.

    A circle if photographs were taken from all sides, else to and fro along most of them. Height and distance are those
    of nearby photographs, so every frame shows what photographs saw. If a model knows the content, the camera steps
    back until it is in the middle of the picture; else it is aimed like nearby photographs.

    Args:
        smooth: degrees of azimuth over which height and distance are averaged.
    """

    num_frames: int = 150
    smooth: float = 20.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_setting("smooth", self.smooth, 0 < self.smooth <= 180, "degrees above 0, at most 180")

    @disable_autocast
    def cameras(self, around: PathFrame) -> Cameras:
        """Return the cameras of the loop; the last frame precedes the first."""
        up, east, north = level_axes(around.up)
        offsets = around.poses[:, :, 3] - around.center
        distances = offsets.norm(dim=-1).clamp(min=1e-6)
        near = distances <= STRAY * distances.median()
        axes, offsets, distances = -around.poses[near, :, 2], offsets[near], distances[near]
        taken = torch.atan2(offsets @ north, offsets @ east).rad2deg()
        heights = (offsets @ up / distances).clamp(-1.0, 1.0).asin().rad2deg()

        azimuth = azimuths(taken, self.num_frames)
        apart = (azimuth[:, None] - taken + 180.0).remainder(360.0) - 180.0
        weights = torch.softmax(-0.5 * (apart / self.smooth).square(), dim=-1)
        height = (weights @ heights).clamp(-HIGHEST, HIGHEST).deg2rad()[:, None]
        distance = (weights @ distances.log()).exp().clamp(min=float(torch.quantile(distances, NEAREST)))
        level = azimuth.deg2rad().cos()[:, None] * east + azimuth.deg2rad().sin()[:, None] * north
        eyes = around.center + distance[:, None] * (height.cos() * level + height.sin() * up)
        content = around.content().to(eyes)
        if len(content):
            middle = content.quantile(content.new_tensor([1.0 - FRAMED, FRAMED]), dim=0).mean(dim=0)
            cameras = self.pinholes(look_at(eyes, middle.expand_as(eyes), up), around)
            farthest = math.inf if around.bounded else float(torch.quantile(distances, FARTHEST))
            return step_back(cameras, content, (farthest - distance).clamp(min=0.0))
        # Aimed like nearby photographs: at the point of their axes nearest to the center.
        aims = offsets - (offsets * axes).sum(dim=-1, keepdim=True) * axes
        return self.pinholes(look_at(eyes, around.center + weights @ aims, up), around)


@disable_autocast
def step_back(cameras: Cameras, content: Float[Tensor, "points 3"], most: Float[Tensor, "frames"]) -> Cameras:
    """Return a loop's cameras, moved back along their axes until most of the content is in their middle.

    A camera whose middle reaches `half` to either side at unit depth shows a point (x, y, -z) there once it has moved
    back by max(|x| / half_x, |y| / half_y) - z.

    Args:
        cameras: pinholes.
        content: points of the content.
        most: maximum motion of each camera.
    """
    half = 0.5 * MIDDLE * torch.stack([cameras.width, cameras.height], dim=-1) / cameras.focal
    x, y, minus_z = ((content - cameras.c2w[:, None, :, 3]) @ cameras.c2w[:, :, :3]).unbind(dim=-1)
    needed = torch.maximum(x.abs() / half[:, :1], y.abs() / half[:, 1:]) + minus_z
    most_of_them = math.ceil(FRAMED * len(content))
    length = needed.kthvalue(most_of_them, dim=1).values.clamp(min=0.0).minimum(most)
    reach = len(length) // (2 * EASED)
    eased = torch.stack([length.roll(step) for step in range(-reach, reach + 1)]).mean(dim=0)
    c2w = cameras.c2w.clone()
    c2w[:, :, 3] += eased[:, None] * c2w[:, :, 2]
    return replace(cameras, c2w=c2w)


def azimuths(taken: Float[Tensor, "views"], num_frames: int) -> Float[Tensor, "frames"]:
    """Return a loop of azimuths in degrees: once around, or to and fro over the arc with the most photographs.

    >>> azimuths(torch.tensor([0.0, 60, 120, 180, 240, 300]), 4).tolist()
    [0.0, 90.0, 180.0, 270.0]
    >>> azimuths(torch.tensor([-20.0, 0, 20, 170]), 4).round().tolist()
    [360.0, 378.0, 360.0, 342.0]
    """
    share = torch.arange(num_frames).to(taken) / num_frames
    in_order, gaps = gaps_around(taken)
    crossed = max(CROSSED, TIMES_THE_USUAL * float(gaps.median()))
    if float(gaps.max()) <= min(crossed, CROSSED_BY_A_CIRCLE):
        return 360.0 * share
    # Begin after the widest gap, and split the photographs where gaps are wide.
    first = int(gaps.argmax()) + 1
    along = torch.cat([in_order[first:], in_order[:first] + 360.0])
    ends = (gaps.roll(-first)[:-1] > crossed).nonzero()[:, 0] + 1
    arc = max(torch.tensor_split(along, ends.tolist()), key=len)
    middle, half = 0.5 * (arc[0] + arc[-1]), 0.5 * OF_AN_ARC * (arc[-1] - arc[0])
    return middle + half * (2.0 * math.pi * share).sin()

"""An ellipse through the cameras of a capture that was taken from all sides, looking at what they look at."""

import math
from dataclasses import dataclass
from typing import final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.frames import focus_point
from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.nerf.matmul_precision import disable_autocast
from nerf_lightning.nerf.types.scene import Cameras
from nerf_lightning.video.paths.base import CameraPath, PathFrame, check_setting, check_turns, level_axes

STEPS = 2048  # So finely the ellipse is measured, to go around it at one speed.


@final
@dataclass
class Ellipse(CameraPath):
    """Go once around on a level ellipse that fits the cameras, at one speed; the last frame precedes the first.

    Its centre lies above or below the point that the photographs look at; its axes are the directions in which the
    cameras stand widest and least apart, as seen from above; its height is theirs (after arXiv 2111.12077's films).

    Args:
        scale: size of the ellipse; 1 takes in nine tenths of the cameras along each axis.
        rise: how far it rises and sinks on the way, as a share of the photographs' own spread in height.
        turns: full circles; negative goes clockwise.
        start: degrees from the long axis at which it begins.
        target: what it looks at, [x, y, z] in the capture's own frame; None: what the photographs look at.
    """

    scale: float = 1.0
    rise: float = 0.0
    turns: float = 1.0
    start: float = 0.0
    target: list[int | float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_setting("scale", self.scale, 0 < self.scale < math.inf, "a positive number")
        check_setting("rise", self.rise, math.isfinite(self.rise), "a finite share")
        check_turns(self.turns, self.start)

    @disable_autocast
    def cameras(self, around: PathFrame) -> Cameras:
        """Return the cameras of the ellipse."""
        focus = focus_point(around.poses)
        target = around.point("target", self.target, focus)
        up, *flat_axes = level_axes(around.up)
        level = torch.stack(flat_axes)
        offsets = around.poses[:, :, 3] - focus
        axes = _axes(offsets @ level.mT)
        reach = self.scale * torch.quantile((offsets @ level.mT @ axes).abs(), 0.9, dim=0)
        angle = self._angles(float(reach[0]), float(reach[1])).to(reach)
        flat = torch.stack([angle.cos(), angle.sin()], dim=-1) * reach @ axes.mT @ level
        low, middle, high = torch.quantile(offsets @ up, torch.tensor([0.1, 0.5, 0.9]).to(up))
        height = middle + self.rise * 0.5 * (high - low) * angle.sin()
        eyes = focus + flat + height[:, None] * up
        return self.pinholes(look_at(eyes, target.expand_as(eyes), up), around)

    def _angles(self, long: float, short: float) -> Float[Tensor, "frames"]:
        """Return the angles that cut the ellipse into arcs of equal length."""
        angle = np.linspace(0.0, 2 * math.pi, STEPS + 1)
        steps = np.hypot(np.diff(long * np.cos(angle)), np.diff(short * np.sin(angle)))
        length = np.concatenate([[0.0], np.cumsum(steps)])
        share = np.arange(self.num_frames) / self.num_frames * self.turns
        begin = np.interp(math.radians(self.start) % (2 * math.pi), angle, length) / length[-1]
        return torch.from_numpy(np.interp((begin + share) % 1.0, length / length[-1], angle))


@disable_autocast
def _axes(flat: Float[Tensor, "views 2"]) -> Float[Tensor, "2 2"]:
    """Return the long and the short axis as columns, the second a quarter turn anticlockwise from the first."""
    long = torch.linalg.eigh(flat.mT @ flat)[1][:, 1]
    long = long * torch.where(long[0] < 0, -1.0, 1.0)
    return torch.stack([long, torch.stack([-long[1], long[0]])], dim=-1)

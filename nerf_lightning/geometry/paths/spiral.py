"""A spiral in front of the scene, as LLFF films captures that were taken from one side."""

import math
from typing import final

import torch

from nerf_lightning.geometry.cameras import pinhole_cameras
from nerf_lightning.geometry.frames import average_pose
from nerf_lightning.geometry.paths.base import CameraPath, PathFrame, check_film, check_setting
from nerf_lightning.geometry.poses import look_at
from nerf_lightning.types import Cameras


@final
class Spiral(CameraPath):
    """Circle around the mean camera, within the reach of the photographs, looking at the middle.

    Args:
        num_frames: how many cameras.
        reach: size of the spiral as a share of how far the photographs were taken apart.
        turns: full circles; on the way the camera goes once nearer and back.
        width: picture's width in pixels; None: it follows the height, or is the photographs'.
        height: picture's height in pixels; None: it follows the width, or is the photographs'.
        fps: frames per second.

    Raises:
        InputError: a number out of its range.
    """

    def __init__(
        self,
        num_frames: int = 120,
        reach: float = 0.7,
        turns: float = 2.0,
        width: int | None = None,
        height: int | None = None,
        fps: int = 30,
    ) -> None:
        check_film(num_frames, width, height, fps)
        check_setting("reach", reach, 0 < reach < math.inf, "a positive share")
        check_setting("turns", turns, math.isfinite(turns) and turns != 0, "a finite number of circles, not 0")
        self.num_frames, self.reach, self.turns, self.fps = num_frames, reach, turns, fps
        self.width, self.height = width, height

    def cameras(self, around: PathFrame) -> Cameras:
        """Return the cameras of the spiral, the last of which precedes the first."""
        mean = average_pose(around.poses)
        offsets = (around.poses[:, :, 3] - mean[:, 3]) @ mean[:, :3]
        # The outermost tenth of the photographs does not count: there, only few of them see the same.
        reach = self.reach * torch.quantile(offsets.abs(), 0.9, dim=0)
        angle = 2 * math.pi * torch.arange(self.num_frames).to(mean) / self.num_frames
        wave = torch.stack([(self.turns * angle).cos(), (self.turns * angle).sin(), angle.sin()], dim=-1)
        eyes = mean[:, 3] + (wave * reach) @ mean[:, :3].mT
        width, height, scale = around.size(self.width, self.height)
        c2w = look_at(eyes, around.center.expand_as(eyes), mean[:, 1])
        return pinhole_cameras(c2w, around.focal * scale, width, height)

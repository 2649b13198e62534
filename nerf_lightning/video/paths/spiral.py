"""A spiral in front of the scene, as LLFF renders captures taken from one side."""

import math
from dataclasses import dataclass
from typing import final

import torch

from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.nerf.geometry.world_frame import average_pose
from nerf_lightning.nerf.matmul_precision import disable_autocast
from nerf_lightning.nerf.types.scene import Cameras
from nerf_lightning.video.paths.base import CameraPath, PathFrame, check_setting, check_turns


@final
@dataclass
class Spiral(CameraPath):
    """Circle around the mean camera, within the reach of the photographs, looking at the middle.

    Args:
        reach: size of the spiral, relative to the spread of the photographs.
        turns: number of turns; during them, the camera moves closer once and back.
        target: the point to look at, [x, y, z] in the capture's own frame; None: the center of the scene.
    """

    reach: float = 0.7
    turns: float = 2.0
    target: list[int | float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_setting("reach", self.reach, 0 < self.reach < math.inf, "a positive share")
        check_turns(self.turns)

    @disable_autocast
    def cameras(self, around: PathFrame) -> Cameras:
        """Return the cameras of the spiral, the last of which precedes the first."""
        target = around.point("target", self.target)
        mean = average_pose(around.poses)
        offsets = (around.poses[:, :, 3] - mean[:, 3]) @ mean[:, :3]
        # The outermost tenth of the photographs does not count: there, few of them see the same.
        reach = self.reach * torch.quantile(offsets.abs(), 0.9, dim=0)
        angle = 2 * math.pi * torch.arange(self.num_frames).to(mean) / self.num_frames
        wave = torch.stack([(self.turns * angle).cos(), (self.turns * angle).sin(), angle.sin()], dim=-1)
        eyes = mean[:, 3] + (wave * reach) @ mean[:, :3].mT
        return self.pinholes(look_at(eyes, target.expand_as(eyes), mean[:, 1]), around)

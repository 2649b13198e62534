"""A straight drive from one place to another, looking at one point all the way."""

from dataclasses import dataclass
from typing import final

import torch

from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.nerf.types.scene import Cameras
from nerf_lightning.video.paths.base import CameraPath, PathFrame


@final
@dataclass
class LookAt(CameraPath):
    """Drive from `start` to `end`, looking at `target`.

    Args:
        num_frames: how many cameras, both ends included; one stays at the start.
        start: [x, y, z] in the capture's own frame; None: where the first photograph was taken.
        end: [x, y, z] in the capture's own frame; None: where the last photograph was taken.
        target: [x, y, z] in the capture's own frame; None: the middle of the scene.
    """

    start: list[int | float] | None = None
    end: list[int | float] | None = None
    target: list[int | float] | None = None

    def cameras(self, around: PathFrame) -> Cameras:
        """Return the cameras of the drive."""
        start = around.point("start", self.start, around.poses[0, :, 3])
        end = around.point("end", self.end, around.poses[-1, :, 3])
        target = around.point("target", self.target)
        share = torch.linspace(0, 1, self.num_frames).to(start)[:, None]
        eyes = start + share * (end - start)
        return self.pinholes(look_at(eyes, target.expand_as(eyes), around.up), around)

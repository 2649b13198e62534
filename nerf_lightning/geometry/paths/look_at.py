"""A straight drive from one place to another, looking at one point all the way."""

from typing import final

import torch

from nerf_lightning.geometry.paths.base import CameraPath, PathFrame
from nerf_lightning.geometry.poses import look_at
from nerf_lightning.types import Cameras


@final
class LookAt(CameraPath):
    """Drive from `start` to `end`, looking at `target`.

    Args:
        num_frames: how many cameras, both ends included; one stays at the start.
        start: [x, y, z] in the capture's own frame; None: where the first photograph was taken.
        end: [x, y, z] in the capture's own frame; None: where the last photograph was taken.
        target: [x, y, z] in the capture's own frame; None: the middle of the scene.
        width: picture's width in pixels; None: it follows the height, or is the photographs'.
        height: picture's height in pixels; None: it follows the width, or is the photographs'.
        fov: degrees that the picture's width takes in; None: as the photographs.
        fps: frames per second.

    Raises:
        InputError: a number out of its range.
    """

    def __init__(
        self,
        num_frames: int = 120,
        start: list[int | float] | None = None,
        end: list[int | float] | None = None,
        target: list[int | float] | None = None,
        width: int | None = None,
        height: int | None = None,
        fov: float | None = None,
        fps: int = 30,
    ) -> None:
        super().__init__(num_frames, width, height, fov, fps)
        self.start, self.end, self.target = start, end, target

    def cameras(self, around: PathFrame) -> Cameras:
        """Return the cameras of the drive."""
        start, end = around.point("start", self.start), around.point("end", self.end)
        start = around.poses[0, :, 3] if start is None else start
        end = around.poses[-1, :, 3] if end is None else end
        target = around.point("target", self.target)
        target = around.center if target is None else target
        share = torch.linspace(0, 1, self.num_frames).to(start)[:, None]
        eyes = start + share * (end - start)
        return self.pinholes(look_at(eyes, target.expand_as(eyes), around.up), around)

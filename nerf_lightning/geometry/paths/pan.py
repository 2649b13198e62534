"""A camera that stays where it is and turns."""

import math
from typing import final

import torch
from torch.nn.functional import normalize

from nerf_lightning.geometry.paths.base import CameraPath, PathFrame, check_setting
from nerf_lightning.geometry.paths.photographs import find_views
from nerf_lightning.geometry.poses import look_at
from nerf_lightning.types import Cameras


@final
class Pan(CameraPath):
    """Turn about the vertical, from the left of where a photograph looks to its right.

    Args:
        num_frames: how many cameras.
        view: the photograph to begin from: its name, or its number from 0.
        position: where to stand instead, [x, y, z] in the capture's own frame, looking at the middle of the scene.
        sweep: degrees to turn in all; 360 makes a panorama, negative turns to the left.
        tilt: degrees to look higher than the photograph.
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
        view: int | str = 0,
        position: list[int | float] | None = None,
        sweep: float = 40.0,
        tilt: float = 0.0,
        width: int | None = None,
        height: int | None = None,
        fov: float | None = None,
        fps: int = 30,
    ) -> None:
        super().__init__(num_frames, width, height, fov, fps)
        check_setting("sweep", sweep, math.isfinite(sweep) and sweep != 0, "a finite angle in degrees, not 0")
        check_setting("tilt", tilt, -180 < tilt < 180, "between -180 and 180 degrees")
        self.view, self.position, self.sweep, self.tilt = view, position, sweep, tilt

    def cameras(self, around: PathFrame) -> Cameras:
        """Return the cameras that turn."""
        pose = around.poses[find_views("view", [self.view], around.view_names, len(around.poses))[0]]
        eye, ahead = around.point("position", self.position), -pose[:, 2]
        if eye is None:
            eye = pose[:, 3]
        else:
            ahead = normalize(around.center - eye, dim=0)
        up = normalize(around.up, dim=0)
        right = normalize(torch.linalg.cross(ahead, up), dim=0)
        level = torch.linalg.cross(up, right)
        height = (ahead @ up).clamp(-1, 1).asin() + math.radians(self.tilt)
        steps = (torch.arange(self.num_frames).to(eye) + 0.5) / self.num_frames - 0.5
        angle = (math.radians(self.sweep) * steps)[:, None]
        directions = height.cos() * (angle.cos() * level + angle.sin() * right) + height.sin() * up
        eyes = eye.expand_as(directions)
        return self.pinholes(look_at(eyes, eyes + directions, up), around)

"""A camera that stays where it is and turns, and one that drives straight on."""

import math
from dataclasses import dataclass
from typing import final

import torch
from torch.nn.functional import normalize

from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.nerf.matmul_precision import disable_autocast
from nerf_lightning.nerf.types.scene import Cameras
from nerf_lightning.video.paths.base import CameraPath, PathFrame, check_setting
from nerf_lightning.video.paths.photograph_path import find_views


@final
@dataclass
class Pan(CameraPath):
    """Turn about the vertical, from the left of where a photograph looks to its right.

    Args:
        view: the photograph to start from: its name, or its number from 0.
        position: the position instead, [x, y, z] in the capture's own frame, looking at the center of the scene.
        sweep: total rotation in degrees; 360 makes a panorama, negative turns left.
        tilt: degrees by which to look higher than the photograph.
    """

    view: int | str = 0
    position: list[int | float] | None = None
    sweep: float = 40.0
    tilt: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        good = math.isfinite(self.sweep) and self.sweep != 0
        check_setting("sweep", self.sweep, good, "a finite angle in degrees, not 0")
        check_setting("tilt", self.tilt, -180 < self.tilt < 180, "between -180 and 180 degrees")

    @disable_autocast
    def cameras(self, around: PathFrame) -> Cameras:
        """Return the cameras that turn."""
        pose = around.poses[find_views("view", [self.view], around.view_names, len(around.poses))[0]]
        eye, ahead = around.point("position", self.position, pose[:, 3]), -pose[:, 2]
        if self.position is not None:
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


@final
@dataclass
class LookAt(CameraPath):
    """Drive from `start` to `end`, looking at `target`.

    Args:
        num_frames: number of cameras, including both ends; one stays at the start.
        start: [x, y, z] in the capture's own frame; None: where the first photograph was taken.
        end: [x, y, z] in the capture's own frame; None: where the last photograph was taken.
        target: [x, y, z] in the capture's own frame; None: the center of the scene.
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

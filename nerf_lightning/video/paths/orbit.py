"""A level circle around the scene, looking at its middle."""

import math
from dataclasses import dataclass
from typing import final

import torch

from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.nerf.types.scene import Cameras
from nerf_lightning.video.paths.base import CameraPath, PathFrame, check_setting, check_turns, level_axes


@final
@dataclass
class Orbit(CameraPath):
    """Circle around the center, anticlockwise from above; the last frame precedes the first, not repeats it.

    Args:
        elevation: degrees above the horizon, between -90 and 90, both excluded.
        radius: distance from the center in the capture's units; None: that of the photographs.
        turns: number of turns; negative: clockwise.
        start: azimuth of the first camera in degrees; 0 is on the world's x axis if z is up.
        center: the center of the circle, [x, y, z] in the capture's own frame; None: the center of the scene.
    """

    elevation: float = 30.0
    radius: float | None = None
    turns: float = 1.0
    start: float = 0.0
    center: list[int | float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        rule = "between -90 and 90 degrees, both excluded"
        check_setting("elevation", self.elevation, -90 < self.elevation < 90, rule)
        good = self.radius is None or 0 < self.radius < math.inf
        check_setting("radius", self.radius, good, "a positive distance, or null")
        check_turns(self.turns, self.start)

    def cameras(self, around: PathFrame) -> Cameras:
        """Return the cameras of the circle."""
        center = around.point("center", self.center)
        radius = around.radius if self.radius is None else self.radius / around.unit
        up, east, north = level_axes(around.up)
        steps = torch.arange(self.num_frames, dtype=up.dtype, device=up.device) / self.num_frames
        azimuth = (math.radians(self.start) + 2 * math.pi * self.turns * steps)[:, None]
        level = torch.cos(azimuth) * east + torch.sin(azimuth) * north
        elevation = math.radians(self.elevation)
        eyes = center + radius * (math.cos(elevation) * level + math.sin(elevation) * up)
        return self.pinholes(look_at(eyes, center.expand_as(eyes), around.up), around)

"""A level circle around the scene, looking at its middle."""

import math
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.geometry.cameras import pinhole_cameras
from nerf_lightning.geometry.paths.base import CameraPath, PathFrame, check_film, check_setting, horizontal
from nerf_lightning.geometry.poses import look_at
from nerf_lightning.types import Cameras


@final
class Orbit(CameraPath):
    """Circle around the centre, anticlockwise from above; the last frame precedes the first, not repeats it.

    Args:
        num_frames: how many cameras.
        elevation: degrees above the horizon, between -90 and 90, both excluded (there the picture has no up).
        radius: distance from the centre in scene units; None: the frame's own, as the photographs were taken.
        turns: full circles; negative goes clockwise.
        start: azimuth of the first camera in degrees; 0 is on the world's x axis where up is z.
        width: picture's width in pixels; None: it follows the height, or is the frame's own.
        height: picture's height in pixels; None: it follows the width, or is the frame's own.
        fps: frames per second.

    Raises:
        InputError: a number out of its range.
    """

    def __init__(
        self,
        num_frames: int = 120,
        elevation: float = 30.0,
        radius: float | None = None,
        turns: float = 1.0,
        start: float = 0.0,
        width: int | None = None,
        height: int | None = None,
        fps: int = 30,
    ) -> None:
        check_film(num_frames, width, height, fps)
        check_setting("elevation", elevation, -90 < elevation < 90, "between -90 and 90 degrees, both excluded")
        check_setting("radius", radius, radius is None or 0 < radius < math.inf, "a positive distance, or null")
        check_setting("turns", turns, math.isfinite(turns) and turns != 0, "a finite number of circles, not 0")
        check_setting("start", start, math.isfinite(start), "a finite angle in degrees")
        self.num_frames, self.elevation, self.radius = num_frames, elevation, radius
        self.turns, self.start, self.fps = turns, start, fps
        self.width, self.height = width, height

    def cameras(self, around: PathFrame) -> Cameras:
        """Return the cameras of the circle. A picture of another size keeps the horizontal field of view."""
        radius = around.radius if self.radius is None else self.radius
        eyes = around.center + radius * self._directions(around.up)
        width, height, scale = around.size(self.width, self.height)
        c2w = look_at(eyes, around.center.expand_as(eyes), around.up)
        return pinhole_cameras(c2w, around.focal * scale, width, height)

    def _directions(self, up: Float[Tensor, "3"]) -> Float[Tensor, "frames 3"]:
        """Return unit vectors from the centre to the cameras."""
        up = normalize(up, dim=0)
        east = horizontal(up)
        north = torch.linalg.cross(up, east)
        steps = torch.arange(self.num_frames, dtype=up.dtype, device=up.device) / self.num_frames
        azimuth = (math.radians(self.start) + 2 * math.pi * self.turns * steps)[:, None]
        level = torch.cos(azimuth) * east + torch.sin(azimuth) * north
        elevation = math.radians(self.elevation)
        return math.cos(elevation) * level + math.sin(elevation) * up

"""The path that suits a capture: around it where it was photographed from all sides, else in front of it."""

from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.frames import gaps_around
from nerf_lightning.nerf.matmul_precision import disable_autocast
from nerf_lightning.nerf.types.scene import Cameras
from nerf_lightning.video.paths.base import CameraPath, PathFrame, check_setting, horizontal
from nerf_lightning.video.paths.orbit import Orbit
from nerf_lightning.video.paths.spiral import Spiral

# The widest gap between photographs, seen from above, that a circle may cross.
WIDEST_GAP = 75.0
LOWEST, HIGHEST = 5.0, 60.0


@final
@dataclass
class AutoPath(CameraPath):
    """An orbit at the photographs' own height, or a spiral.

    Args:
        longest: where neither width nor height is given, the picture is as large as the photographs, but its longer
            side has at most so many pixels: a film of photographs at full size takes hours.
    """

    longest: int = 480

    def __post_init__(self) -> None:
        super().__post_init__()
        check_setting("longest", self.longest, self.longest >= 1, "at least 1 pixel")

    @disable_autocast
    def cameras(self, around: PathFrame) -> Cameras:
        """Return the cameras of the path that was chosen."""
        width = self.width
        if width is None and self.height is None:
            width = max(1, round(around.width * min(1.0, self.longest / max(around.width, around.height))))
        from_center = around.poses[:, :, 3] - around.center
        if widest_gap(from_center, around.up) > WIDEST_GAP:
            return Spiral(self.num_frames, width=width, height=self.height, fov=self.fov).cameras(around)
        height = from_center @ around.up / (from_center.norm(dim=-1) * around.up.norm())
        elevation = float(torch.rad2deg(height.clamp(-1, 1).asin()).median())
        elevation = min(max(elevation, LOWEST), HIGHEST)
        return Orbit(self.num_frames, elevation, width=width, height=self.height, fov=self.fov).cameras(around)


@disable_autocast
def widest_gap(offsets: Float[Tensor, "views 3"], up: Float[Tensor, "3"]) -> float:
    """Return the widest angle in degrees between neighbouring views, as seen from above.

    >>> east_and_north = torch.tensor([[1.0, 0, 0], [0, 1, 0]])
    >>> round(widest_gap(east_and_north, torch.tensor([0.0, 0, 1])))
    270
    """
    up = up / up.norm()
    east = horizontal(up)
    north = torch.linalg.cross(up, east)
    return float(gaps_around(torch.atan2(offsets @ north, offsets @ east).rad2deg())[1].max())

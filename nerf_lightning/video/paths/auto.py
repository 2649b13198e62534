"""The path that suits a capture: around what its photographs show, in front of it, or past the photographs."""

from dataclasses import dataclass
from typing import final

from torch.nn.functional import normalize

from nerf_lightning.nerf.geometry.world_frame import FORWARD_FACING, average_pose, least_agreement
from nerf_lightning.nerf.matmul_precision import disable_autocast
from nerf_lightning.nerf.types.scene import Cameras
from nerf_lightning.video.paths.base import CameraPath, PathFrame, check_setting
from nerf_lightning.video.paths.spiral import Spiral
from nerf_lightning.video.paths.sweep import Sweep
from nerf_lightning.video.paths.walk import Walk

FACING = 0.7  # Minimum cosine between most photographs' directions and that to the center
BEYOND = 0.05  # Share of the photographs that may have the center behind them


@final
@dataclass
class AutoPath(CameraPath):
    """A sweep around what the photographs show, a spiral in front of what faces them, or a walk past them.

    Args:
        longest: without width and height, the maximum length of the longer side, in pixels; otherwise images are as
            large as the photographs. Films at full size take hours.
    """

    num_frames: int = 150
    longest: int = 480

    def __post_init__(self) -> None:
        super().__post_init__()
        check_setting("longest", self.longest, self.longest >= 1, "at least 1 pixel")

    @disable_autocast
    def cameras(self, around: PathFrame) -> Cameras:
        """Return the cameras of the chosen path."""
        width = self.width
        if width is None and self.height is None:
            width = max(1, round(around.width * min(1.0, self.longest / max(around.width, around.height))))
        path = Sweep if looks_at_center(around) else Spiral if faces_one_way(around) else Walk
        return path(self.num_frames, width=width, height=self.height, fov=self.fov).cameras(around)


@disable_autocast
def looks_at_center(around: PathFrame) -> bool:
    """Return whether most photographs show the center, seen from different sides; forward-facing captures have none.

    Neither does a walk along a street, where some photographs were taken beyond what the others show.
    """
    if around.forward_facing:
        return False
    offsets = normalize(around.poses[:, :, 3] - around.center, dim=-1)
    cosines = (offsets * around.poses[:, :, 2]).sum(dim=-1)
    return float(cosines.median()) > FACING and float((cosines < 0.0).float().mean()) <= BEYOND


@disable_autocast
def faces_one_way(around: PathFrame) -> bool:
    """Return whether the photographs were taken side by side, in the same direction, and not one ahead of another."""
    if around.forward_facing:
        return True
    mean = average_pose(around.poses)
    spread = ((around.poses[:, :, 3] - mean[:, 3]) @ mean[:, :3]).std(dim=0, correction=0)
    return least_agreement(around.poses) > FORWARD_FACING and float(spread[2]) < float(spread[:2].max())

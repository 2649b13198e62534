"""The contract of a camera path: a frame of reference in, cameras in order of time out."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.errors import InputError
from nerf_lightning.types import Cameras

# What a camera in front of a scene looks at, in units of the near plane's distance.
NDC_FOCUS = 5.0


@dataclass(frozen=True)
class PathFrame:
    """What a path moves around, and through what kind of camera it looks."""

    center: Float[Tensor, "3"]
    """The point to look at, in scene coordinates."""
    up: Float[Tensor, "3"]
    """Where the top of the picture points; any length but zero."""
    radius: float
    """How far the photographs were taken from the centre, in scene units."""
    focal: float
    """Focal length in pixels, for a picture of `width` by `height`."""
    width: int
    height: int
    poses: Float[Tensor, "views 3 4"]
    """Where the photographs were taken, camera to world."""

    def size(self, width: int | None, height: int | None) -> tuple[int, int, float]:
        """Return a picture's width, height, and how much longer its focal length is in pixels.

        Args:
            width: in pixels; None: it follows the height, or is the frame's own.
            height: in pixels; None: it follows the width, or is the frame's own.
        """
        if width is None and height is not None:
            scale = height / self.height
            return max(1, round(self.width * scale)), height, scale
        width = self.width if width is None else width
        scale = width / self.width
        return width, (max(1, round(self.height * scale)) if height is None else height), scale


def check_setting(name: str, value: object, good: bool, rule: str) -> None:
    """Refuse a setting of a path.

    Raises:
        InputError: it is not good.
    """
    if not good:
        raise InputError(f"path.{name} is {value}, but must be {rule}")


def check_film(num_frames: int, width: int | None, height: int | None, fps: int) -> None:
    """Refuse what no film can be.

    Raises:
        InputError: a setting that all paths share is out of its range.
    """
    check_setting("num_frames", num_frames, num_frames >= 1, "at least 1")
    check_setting("width", width, width is None or width >= 1, "at least 1 pixel, or null")
    check_setting("height", height, height is None or height >= 1, "at least 1 pixel, or null")
    check_setting("fps", fps, fps >= 1, "at least 1")


def horizontal(up: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Return where azimuth 0 lies: the x axis brought to the horizon, or the y axis where x is nearly up."""
    axis = torch.zeros_like(up)
    axis[0 if abs(float(up[0])) < 0.9 else 1] = 1.0
    return normalize(axis - (axis @ up) * up, dim=0)


class CameraPath(ABC):
    """A path of virtual cameras for a video."""

    fps: int
    """Frames per second at which the path is meant to be played."""

    @abstractmethod
    def cameras(self, around: PathFrame) -> Cameras:
        """Return one camera per frame, all of one size, in order of time."""


def frame_of(
    cameras: Cameras, aabb: Float[Tensor, "2 3"], up: tuple[float, float, float] = (0.0, 0.0, 1.0)
) -> PathFrame:
    """Return the frame of a capture: the middle of its box, seen from the mean distance of its cameras.

    Forward-facing captures have no middle: theirs lies in front of the mean camera, a few times as far as the near
    plane, and up is the mean camera's.

    Focal length and size are those of the first camera; its lens and principal point are left behind, for what is
    rendered on a path is seen through a centred pinhole. The default `up` is the world's z axis.
    """
    center = aabb.mean(dim=0).to(cameras.c2w)
    if cameras.ndc is not None:
        center, up = torch.tensor([0.0, 0.0, -NDC_FOCUS]).to(cameras.c2w), (0.0, 1.0, 0.0)
    return PathFrame(
        center=center,
        up=torch.tensor(up).to(cameras.c2w),
        radius=float((cameras.c2w[:, :, 3] - center).norm(dim=-1).mean()),
        focal=float(cameras.focal[0, 0]),
        width=int(cameras.width[0]),
        height=int(cameras.height[0]),
        poses=cameras.c2w,
    )

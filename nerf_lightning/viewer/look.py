"""What a person wants to see: a place to look from, in a window of some size; and the cameras that show it."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.checkpoints import SceneRecord
from nerf_lightning.geometry.cameras import focal_from_fov, pinhole_cameras, resized
from nerf_lightning.geometry.clipping import CropBox
from nerf_lightning.geometry.paths.base import frame_of
from nerf_lightning.geometry.poses import rotation_from_quaternion
from nerf_lightning.types.scene import Cameras

# A viewer that stands closer than this share of the photographs' distance is cut no more off at the near plane.
LEAST_NEAR = 0.01


@dataclass(frozen=True, eq=False)
class Look:
    """One wish of a person; a new wish is a new object."""

    c2w: Float[Tensor, "3 4"]
    """Camera to world, columns right, up, back, centre; the model's frame."""
    fov: float
    """Vertical field of view in radians."""
    width: int
    """The window in pixels."""
    height: int
    crop: CropBox | None = None
    """Only what lies in this box is shown; None: all."""
    photograph: int | None = None
    """Look through the camera of this view, lens included, with its picture in the middle of the window."""


def pose_of(wxyz: Float[Tensor, "4"], position: Float[Tensor, "3"]) -> Float[Tensor, "3 4"]:
    """Return the pose of a camera whose rotation is given with axes right, down, forward (OpenCV's).

    >>> back = pose_of(torch.tensor([1.0, 0, 0, 0]), torch.zeros(3))[:, 2]
    >>> (back + 0.0).tolist()  # it looks along z
    [0.0, 0.0, -1.0]
    """
    turned = rotation_from_quaternion(wxyz) * torch.tensor([1.0, -1.0, -1.0]).to(wxyz)
    return torch.cat([turned, position[:, None]], dim=-1)


def camera_of(look: Look, record: SceneRecord, height: int) -> tuple[Cameras, Tensor, Tensor]:
    """Return one camera for a picture of about this height, and its near and far.

    A photograph's camera keeps the photograph's shape, and fits into the window.
    """
    if look.photograph is not None:
        view = slice(look.photograph, look.photograph + 1)
        cameras, near, far = record.cameras[view], record.near[view], record.far[view]
        shrunk = height / max(int(cameras.height), int(cameras.width) * look.height / look.width)
        sizes = ((size * shrunk).round().long().clamp(min=2) for size in (cameras.width, cameras.height))
        return resized(cameras, *sizes), near, far
    width = max(2, round(height * look.width / look.height))
    cameras = pinhole_cameras(look.c2w[None], focal_from_fov(height, look.fov), width, height)
    near, far = record.near.min(), record.far.max()
    if record.cameras.ndc is not None:
        cameras = replace(cameras, ndc=record.cameras.ndc[:1])
    elif record.space == "bounded":
        # Near and far go with the person, so that the box is neither cut off from close by nor lost from afar.
        around = frame_of(record.cameras, record.aabb)
        beyond = (look.c2w[:, 3] - around.center).norm() - around.radius
        near, far = (near + beyond).clamp(min=LEAST_NEAR * around.radius), far + beyond.clamp(min=0.0)
    return cameras, near[None], far[None]

"""What the user wants to see: a viewpoint in a window of some size, and the cameras that show it."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.cameras import focal_from_fov, pinhole_cameras, resized
from nerf_lightning.nerf.geometry.clipping import CropBox
from nerf_lightning.nerf.geometry.near_far_of_new_views import near_and_far_from
from nerf_lightning.nerf.geometry.poses import flip_yz, quaternion_from_rotation, rotation_from_quaternion
from nerf_lightning.nerf.types.scene import Cameras, SceneRecord
from nerf_lightning.video.paths.base import PathFrame


@dataclass(frozen=True, eq=False)
class CameraState:
    """The camera that a user requests; a new request is a new object."""

    c2w: Float[Tensor, "3 4"]
    """Camera to world, columns right, up, back, center; the model's frame."""
    fov: float
    """Vertical field of view in radians."""
    width: int
    """Size of the window in pixels."""
    height: int
    crop: CropBox | None = None
    """Only content in this box is shown; None: everything."""
    photograph: int | None = None
    """Look through the camera of this view, including its lens, with its picture centered in the window."""


def fov_that_holds(fov: float, shape: float, window: float) -> float:
    """Return the vertical field of view (radians) at which a window shows all of a photograph with field of view `fov`.

    `shape` is the photograph's width over its height, `window` the window's.

    >>> round(fov_that_holds(1.0, 1.5, 2.0), 3), round(fov_that_holds(math.pi / 2, 2.0, 1.0), 3)
    (1.0, 2.214)
    """
    return 2 * math.atan(math.tan(0.5 * fov) * max(1.0, shape / window))


def fov_held_by(fov: float, shape: float, window: float) -> float:
    """Return the vertical field of view of a picture of this shape that just fits a window with this field of view.

    >>> round(fov_held_by(fov_that_holds(0.7, 2.0, 1.0), 2.0, 1.0), 3)
    0.7
    """
    return 2 * math.atan(math.tan(0.5 * fov) / max(1.0, shape / window))


def pose_of(wxyz: Float[Tensor, "4"], position: Float[Tensor, "3"]) -> Float[Tensor, "3 4"]:
    """Return the pose of a camera whose rotation is given with axes right, down, forward (OpenCV's).

    >>> back = pose_of(torch.tensor([1.0, 0, 0, 0]), torch.zeros(3))[:, 2]
    >>> (back + 0.0).tolist()  # it looks along z
    [0.0, 0.0, -1.0]
    """
    return flip_yz(torch.cat([rotation_from_quaternion(wxyz), position[:, None]], dim=-1))


def quaternion_of(c2w: Tensor) -> np.ndarray:
    """Return the rotation of a pose in viser's form: w, x, y, z for the axes right, down, forward."""
    return quaternion_from_rotation(flip_yz(c2w)[:, :3].double()).numpy()


def point_ahead(c2w: Float[Tensor, "3 4"], around: PathFrame) -> Float[Tensor, "3"]:
    """Return what a user at a photograph's camera turns around: on its axis, about as far away as the center."""
    ahead = max(float((c2w[:, 3] - around.center) @ c2w[:, 2]), 0.1 * around.radius)
    return c2w[:, 3] - ahead * c2w[:, 2]


def camera_of(state: CameraState, record: SceneRecord, height: int) -> tuple[Cameras, Tensor, Tensor]:
    """Return a camera for a picture of about this height, with its near and far.

    A photograph's camera keeps its aspect ratio, and fits into the window.
    """
    if state.photograph is not None:
        view = slice(state.photograph, state.photograph + 1)
        cameras, near, far = record.cameras[view], record.near[view], record.far[view]
        shrunk = height / max(int(cameras.height), int(cameras.width) * state.height / state.width)
        sizes = ((size * shrunk).round().long().clamp(min=2) for size in (cameras.width, cameras.height))
        return resized(cameras, *sizes), near, far
    width = max(2, round(height * state.width / state.height))
    cameras = pinhole_cameras(state.c2w[None], focal_from_fov(height, state.fov), width, height)
    if record.cameras.ndc is not None:
        cameras = replace(cameras, ndc=record.cameras.ndc[:1])
    return cameras, *near_and_far_from(state.c2w[None, :, 3], record)

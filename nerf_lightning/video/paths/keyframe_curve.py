"""The smooth curve through keyframes: a camera's pose and field of view at any time."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import focal_from_fov
from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.video.paths.base import PathFrame
from nerf_lightning.video.paths.keyframes import Keyframe
from nerf_lightning.video.paths.spline import along, even_speed, poses_along

LEAST_SINE = 1e-6  # Of the angle between a keyframe's direction and its up: less is rounding.


class KeyframeCurve:
    """A curve through keyframes (`video.paths.spline`), as `KeyframePath` describes.

    Args:
        keyframes: two or more.
        around: the capture.
        times: when each is passed, and for a closed curve when the first one is passed again (seconds); empty: at about
            constant speed, from 0 to 1.
        closed: return to the first keyframe.
    """

    def __init__(self, keyframes: Sequence[Keyframe], around: PathFrame, times: Sequence[float], closed: bool = False):
        # Times may be close together for a long path.
        self._keys = keyframe_poses(keyframes, around).double()
        even = even_speed(self._keys, around.radius, closed)
        self.knots = torch.tensor(times, dtype=self._keys.dtype) if times else even
        self._targets = torch.stack([around.point("file", each.look_at) for each in keyframes]).double()
        logs = [[math.log(keyframe_focal(each, around))] for each in keyframes]
        self._log_focal = torch.tensor(logs, dtype=self.knots.dtype)

    def poses(self, at: Float[Tensor, "frames"]) -> Float[Tensor, "frames 3 4"]:
        """Return the camera-to-world poses at some times."""
        c2w = poses_along(self.knots, self._keys, at)
        eyes = c2w[:, :, 3]
        back = normalize(eyes - along(self.knots, self._targets, at), dim=-1)
        right = normalize(torch.linalg.cross(c2w[:, :, 1], back), dim=-1)
        return torch.stack([right, torch.linalg.cross(back, right), back, eyes], dim=-1)

    def focal(self, at: Float[Tensor, "frames"]) -> Float[Tensor, "frames"]:
        """Return the focal lengths at some times (pixels, at the photographs' width), geometric between keyframes."""
        focal = along(self.knots, self._log_focal, at).exp()[:, 0].float()
        if not bool(((focal > 0) & torch.isfinite(focal)).all()):
            raise InputError(
                "path.file: the curve through the keyframes' fields of view swings beyond all cameras. Give times that "
                "are more even, or leave them out."
            )
        return focal


def keyframe_poses(keyframes: Sequence[Keyframe], around: PathFrame) -> Float[Tensor, "keys 3 4"]:
    """Return the camera-to-world poses of keyframes, none of which may look along its up."""
    poses = [torch.zeros(0, 3, 4).to(around.center)]
    for number, each in enumerate(keyframes, start=1):
        eye = around.point("file", each.position)
        up = normalize(around.up, dim=0) if each.up is None else around.direction(each.up)
        ahead = around.direction(each.ahead)
        if float(torch.linalg.cross(ahead, up).norm()) < LEAST_SINE:
            raise InputError(
                f"path.file: keyframe {number} looks straight along its up, so its picture has no top. Give it another."
            )
        poses.append(look_at(eye, eye + ahead, up)[None])
    return torch.cat(poses)


def keyframe_focal(keyframe: Keyframe, around: PathFrame) -> float:
    """Return a keyframe's focal length in pixels, for a picture as wide as the photographs."""
    return around.focal if keyframe.fov is None else focal_from_fov(around.width, math.radians(keyframe.fov))

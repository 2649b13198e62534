"""A smooth path through the cameras of a keyframe file."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.files.budgets import limits
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import focal_from_fov
from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.nerf.types.scene import Cameras
from nerf_lightning.video.paths.base import CameraPath, PathFrame
from nerf_lightning.video.paths.keyframes import Keyframe, read_keyframes
from nerf_lightning.video.paths.spline import along, even_speed, frame_times, poses_along

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

    def poses(self, times: Float[Tensor, "frames"]) -> Float[Tensor, "frames 3 4"]:
        """Return the camera-to-world poses at some times."""
        c2w = poses_along(self.knots, self._keys, times)
        eyes = c2w[:, :, 3]
        back = normalize(eyes - along(self.knots, self._targets, times), dim=-1)
        right = normalize(torch.linalg.cross(c2w[:, :, 1], back), dim=-1)
        return torch.stack([right, torch.linalg.cross(back, right), back, eyes], dim=-1)

    def focal(self, times: Float[Tensor, "frames"]) -> Float[Tensor, "frames"]:
        """Return the focal lengths at some times (pixels, at the photographs' width), geometric between keyframes."""
        focal = along(self.knots, self._log_focal, times).exp()[:, 0].float()
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


FRAMES_WITHOUT_TIMES = 120


@final
class KeyframePath(CameraPath):
    """Follow a smooth curve through the keyframes of a file (`video.paths.keyframes`).

    If all of them have a look_at, the point that the camera looks at moves on such a curve, too, so a point that they
    share stays in the middle.

    Args:
        file: the keyframe file.
        num_frames: number of cameras; None: from the keyframes' times and `fps`, or 120 without times.
        closed: return to the first keyframe at the end, in the mean time between keyframes; the last frame then
            precedes the first.
        width: image width in pixels; None: from the height, or as the photographs.
        height: image height in pixels; None: from the width, or as the photographs.
        fov: horizontal field of view in degrees, for all frames; None: as the keyframes, otherwise as the photographs.
        fps: frames per second.
    """

    def __init__(
        self,
        file: str,
        num_frames: int | None = None,
        closed: bool = False,
        width: int | None = None,
        height: int | None = None,
        fov: float | None = None,
        fps: int = 30,
    ) -> None:
        super().__init__(1 if num_frames is None else num_frames, width=width, height=height, fov=fov, fps=fps)
        self.asked_frames, self.closed = num_frames, closed
        self.keyframes = read_keyframes(Path(file).expanduser())
        self.times = _times(self.keyframes, closed)
        if num_frames is None and self._count() > limits().film_frames:
            raise InputError(
                f"{file}: the times of its keyframes last {self.times[-1]:,.6g} seconds, which makes {self._count():,} "
                f"frames at path.fps={self.fps}, more than {limits().film_frames:,}. Give times in seconds, or "
                "path.num_frames."
            )

    def cameras(self, around: PathFrame) -> Cameras:
        """Return the cameras between the keyframes."""
        curve = KeyframeCurve(self.keyframes, around, self.times, self.closed)
        times = frame_times(curve.knots, self._count(), self.closed)
        cameras = self.pinholes(curve.poses(times).to(around.center), around)
        if self.fov is not None:
            return cameras
        scale = cameras.width[0] / around.width
        return replace(
            cameras, focal=(scale * curve.focal(times)[:, None]).expand(-1, 2).to(cameras.focal).contiguous()
        )

    @property
    def seconds(self) -> float:
        """The time from the first camera to the last, or back to the first."""
        return (self._count() - (not self.closed)) / self.fps

    def _count(self) -> int:
        if self.asked_frames is not None:
            return self.asked_frames
        if not self.times:
            return FRAMES_WITHOUT_TIMES
        return max(1, round(self.times[-1] * self.fps) + (not self.closed))


def _times(keyframes: Sequence[Keyframe], closed: bool) -> list[float]:
    """Return when each keyframe is passed, and last when the first one is passed again, in seconds from the first."""
    given = [each.time for each in keyframes if each.time is not None]
    times = [time - given[0] for time in given]
    return [*times, times[-1] + times[-1] / (len(times) - 1)] if closed and times else times

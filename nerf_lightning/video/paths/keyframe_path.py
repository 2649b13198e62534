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

from nerf_lightning.budgets import allowed
from nerf_lightning.errors import InputError
from nerf_lightning.nerf.geometry.cameras import focal_from_fov
from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.nerf.types.scene import Cameras
from nerf_lightning.video.paths.base import CameraPath, PathFrame
from nerf_lightning.video.paths.keyframes import Keyframe, read_keyframes
from nerf_lightning.video.paths.spline import along, even_speed, frame_times, poses_along

FRAMES_WITHOUT_TIMES = 120


@final
class KeyframePath(CameraPath):
    """Go through the keyframes of a file (`geometry.paths.keyframes`) on a smooth curve.

    Where all of them have a look_at, what the camera looks at moves on such a curve too, so one point that they share
    stays in the middle.

    Args:
        file: the keyframe file.
        num_frames: how many cameras; None: as many as the keyframes' times and `fps` make, or 120 without times.
        closed: go back to the first keyframe at the end, in a mean leg's time; the last frame then precedes the first.
        width: picture's width in pixels; None: it follows the height, or is the photographs'.
        height: picture's height in pixels; None: it follows the width, or is the photographs'.
        fov: degrees that the picture's width takes in, for all frames; None: as the keyframes, else as the photographs.
        fps: frames per second.

    Raises:
        InputError: a number out of its range, or a file that is no keyframe file.
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
        if num_frames is None:
            self._check_length(file)

    def cameras(self, around: PathFrame) -> Cameras:
        """Return the cameras between the keyframes."""
        keys = _poses(self.keyframes, around).double()  # times may lie close together for a long path
        knots = self._knots(keys, around)
        at = frame_times(knots, self._count(), self.closed)
        c2w = poses_along(knots, keys, at)
        targets = [around.point("file", each.look_at) for each in self.keyframes]
        if all(target is not None for target in targets):
            held = along(knots, torch.stack([target for target in targets if target is not None]).double(), at)
            eyes = c2w[:, :, 3]
            back = normalize(eyes - held, dim=-1)
            right = normalize(torch.linalg.cross(c2w[:, :, 1], back), dim=-1)
            c2w = torch.stack([right, torch.linalg.cross(back, right), back, eyes], dim=-1)
        cameras = self.pinholes(c2w.to(around.center), around)
        return cameras if self.fov is not None else self._zoomed(cameras, knots, at, around)

    def _knots(self, keys: Tensor, around: PathFrame) -> Float[Tensor, "knots"]:
        if not self.times:
            return even_speed(keys, around.radius, self.closed)
        return torch.tensor(self.times, dtype=keys.dtype)

    def _count(self) -> int:
        if self.asked_frames is not None:
            return self.asked_frames
        if not self.times:
            return FRAMES_WITHOUT_TIMES
        return max(1, round(self.times[-1] * self.fps) + (not self.closed))

    def _check_length(self, file: str) -> None:
        if self._count() > allowed().film_frames:
            raise InputError(
                f"{file}: the times of its keyframes last {self.times[-1]:,.6g} seconds, which makes {self._count():,} "
                f"frames at path.fps={self.fps}; more than {allowed().film_frames:,} are not taken from times. "
                "Give them in seconds, or the number of frames with path.num_frames."
            )

    def _zoomed(self, cameras: Cameras, knots: Tensor, at: Tensor, around: PathFrame) -> Cameras:
        """Return the cameras with the keyframes' focal lengths, between them even in ratio."""
        logs = torch.tensor([[math.log(_focal(each, around))] for each in self.keyframes], dtype=knots.dtype)
        scale = cameras.width[0] / around.width
        focal = (scale * along(knots, logs, at).exp()).expand(-1, 2).to(cameras.focal)
        if not bool(((focal > 0) & torch.isfinite(focal)).all()):
            raise InputError(
                "path.file: the curve through the keyframes' fields of view swings beyond all cameras, since their "
                "times are very uneven. Give times that are more alike, or leave them out."
            )
        return replace(cameras, focal=focal.contiguous())


def _poses(keyframes: Sequence[Keyframe], around: PathFrame) -> Float[Tensor, "keys 3 4"]:
    poses = []
    for number, each in enumerate(keyframes, start=1):
        eye = around.point("file", each.position)
        assert eye is not None
        up = around.up if each.up is None else around.direction(each.up)
        pose = look_at(eye, eye + around.direction(each.ahead), up)
        if float(pose[:, 0].norm()) < 0.5:
            raise InputError(
                f"path.file: keyframe {number} looks straight along its up, so its picture has no top. Give it another "
                "`up`, for instance one that is horizontal."
            )
        poses.append(pose)
    return torch.stack(poses)


def _times(keyframes: Sequence[Keyframe], closed: bool) -> list[float]:
    """Return when each keyframe is passed, and at the end when the first one is again, in seconds from the first."""
    given = [each.time for each in keyframes if each.time is not None]
    times = [time - given[0] for time in given]
    return [*times, times[-1] + times[-1] / (len(times) - 1)] if closed and times else times


def _focal(keyframe: Keyframe, around: PathFrame) -> float:
    """Return a keyframe's focal length in pixels of a picture as wide as the photographs."""
    if keyframe.fov is not None:
        return focal_from_fov(around.width, math.radians(keyframe.fov))
    return around.focal if keyframe.focal is None else keyframe.focal

"""A smooth path through the cameras of a keyframe file."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import final

from nerf_lightning.files.budgets import limits
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.types.scene import Cameras
from nerf_lightning.video.paths.base import CameraPath, PathFrame
from nerf_lightning.video.paths.keyframe_curve import KeyframeCurve
from nerf_lightning.video.paths.keyframes import Keyframe, read_keyframes
from nerf_lightning.video.paths.spline import frame_times

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
        at = frame_times(curve.knots, self._count(), self.closed)
        cameras = self.pinholes(curve.poses(at).to(around.center), around)
        if self.fov is not None:
            return cameras
        scale = cameras.width[0] / around.width
        return replace(cameras, focal=(scale * curve.focal(at)[:, None]).expand(-1, 2).to(cameras.focal).contiguous())

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

"""A camera path that the user makes of keyframes: added, changed, read from a file, and saved to one."""

import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import accumulate, count, pairwise
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.files.made_folders import make_folder
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.world_frame import directions_to_user, points_to_user
from nerf_lightning.video.paths.base import PathFrame
from nerf_lightning.video.paths.keyframe_path import KeyframeCurve, keyframe_focal, keyframe_poses
from nerf_lightning.video.paths.keyframes import Keyframe, read_keyframes, write_keyframes

USUAL_SECONDS = 2.0
ENDING = ".yaml"


class RecordedPath:
    """Keyframes in a capture, in order, and the time from each to the next; files are in `folder`."""

    def __init__(self, around: PathFrame, folder: Path):
        self.around, self.folder = around, folder
        self.keyframes: list[Keyframe] = []
        self.legs: list[float] = []
        """Seconds from the previous keyframe; meaningless for the first one."""

    @property
    def shape(self) -> float:
        """Width over height of its pictures, as of the photographs."""
        return self.around.width / self.around.height

    @property
    def times(self) -> list[float]:
        """When each keyframe is passed, in seconds from the first."""
        return list(accumulate(self.legs[1:], initial=0.0))

    def insert(self, number: int, keyframe: Keyframe) -> None:
        """Insert a keyframe at this place of the list, or say that its picture has no top."""
        keyframe_poses([keyframe], self.around)
        self.keyframes.insert(number, keyframe)
        self.legs.insert(number, USUAL_SECONDS)

    def remove(self, number: int) -> None:
        """Remove a keyframe."""
        del self.keyframes[number], self.legs[number]

    def views(self) -> list[tuple[Float[Tensor, "3 4"], float]]:
        """Return the camera-to-world pose of each keyframe, and its vertical field of view in radians."""
        focals = [keyframe_focal(each, self.around) for each in self.keyframes]
        return list(zip(keyframe_poses(self.keyframes, self.around), map(self._vertical, focals), strict=True))

    def curve(self) -> KeyframeCurve | None:
        """Return the curve through the keyframes; None if there are fewer than two."""
        return KeyframeCurve(self.keyframes, self.around, self.times) if len(self.keyframes) > 1 else None

    def view_at(self, curve: KeyframeCurve, seconds: float) -> tuple[Float[Tensor, "3 4"], float]:
        """Return the camera-to-world pose at a time, and its vertical field of view in radians."""
        at = torch.tensor([seconds], dtype=curve.knots.dtype).clamp(0.0, float(curve.knots[-1]))
        return curve.poses(at)[0].float(), self._vertical(float(curve.focal(at)))

    def files(self) -> list[str]:
        """Return the names of the keyframe files in the folder, without links, newest first."""
        try:
            found = [each for each in self.folder.glob(f"[!.]*{ENDING}") if each.is_file() and not each.is_symlink()]
            return [each.name for each in sorted(found, key=lambda each: each.stat().st_mtime, reverse=True)]
        except OSError:  # a file is being removed
            return []

    def load(self, name: str) -> None:
        """Replace the keyframes with those of a file in the folder; they stay if it is not a valid path here."""
        if name not in self.files():
            raise InputError(f"There is no keyframe file of this name in {self.folder} any more.")
        keyframes = read_keyframes(self.folder / name)
        given = [each.time for each in keyframes if each.time is not None]
        curve = KeyframeCurve(keyframes, self.around, given)
        times = given or (curve.knots * USUAL_SECONDS * (len(keyframes) - 1)).tolist()
        self.keyframes, self.legs = keyframes, [0.0, *(after - before for before, after in pairwise(times))]

    def timed(self) -> list[Keyframe]:
        """Return the keyframes with their times."""
        return [replace(each, time=round(time, 3)) for each, time in zip(self.keyframes, self.times, strict=True)]

    def save(self) -> Path:
        """Write a file with a new name, and return its path."""
        with new_file(self.folder, "camera_path", ENDING) as path:
            write_keyframes(path, self.timed())
        return path

    def _vertical(self, focal: float) -> float:
        return 2 * math.atan(0.5 * self.around.height / focal)


def keyframe_of(
    position: Float[Tensor, "3"], look_at: Float[Tensor, "3"], up: Float[Tensor, "3"], fov: float, around: PathFrame
) -> Keyframe:
    """Return a keyframe, in the user's frame, of a camera in the model's frame.

    `fov` is vertical, in radians. A film has the photographs' aspect ratio, not the window's, and keeps this field of
    view.
    """
    to_user, shape = around.to_user.double(), around.width / around.height
    rows = [*points_to_user(torch.stack([position, look_at]).double(), to_user)]
    rows.append(directions_to_user(up.double(), to_user))
    eye, target, top = ((round(x, 6), round(y, 6), round(z, 6)) for x, y, z in (row.tolist() for row in rows))
    degrees = math.degrees(2 * math.atan(shape * math.tan(fov / 2)))
    return Keyframe(position=eye, look_at=target, up=top, fov=round(degrees, 3))


@contextmanager
def new_file(folder: Path, stem: str, ending: str) -> Iterator[Path]:
    """Yield a path with the first number that no file has; names never come from the page.

    An empty file reserves the name, so that several browsers that save at once get different ones; it is removed if the
    block fails.
    """
    make_folder(folder)
    for number in count(1):
        path = folder / f"{stem}_{number:03d}{ending}"
        with suppress(FileExistsError):
            path.touch(exist_ok=False)
            break
    try:
        yield path
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def error_message(error: Exception) -> str:
    """Return the message for a request that failed, or a file that could not be written."""
    if not isinstance(error, OSError):
        return str(error)
    return f"It could not be saved: {error}. Make room, or start again with another paths.output_dir=DIR."

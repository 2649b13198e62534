"""A camera path that somebody makes of keyframes: added, changed, moved, read from a file, and saved as one."""

import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import accumulate, pairwise
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.files.made_folders import make_folder
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.types.scene import SceneRecord
from nerf_lightning.video.paths.base import PathFrame
from nerf_lightning.video.paths.keyframe_curve import KeyframeCurve, keyframe_focal, keyframe_poses
from nerf_lightning.video.paths.keyframes import Keyframe, Point, read_keyframes, write_keyframes
from nerf_lightning.viewer import limits

LEAST_SECONDS, USUAL_SECONDS = 0.1, 2.0
ENDING = ".yaml"


class RecordedPath:
    """Keyframes in order, and how long the camera takes from each to the next.

    Args:
        around: the capture that they stand in.
        folder: where files lie, and are written.
    """

    def __init__(self, around: PathFrame, folder: Path):
        self.around, self.folder = around, folder
        self.keyframes: list[Keyframe] = []
        self.legs: list[float] = []
        """Seconds from the keyframe before; of the first one 0."""

    @property
    def shape(self) -> float:
        """Width over height of its pictures, which are the photographs'."""
        return self.around.width / self.around.height

    @property
    def times(self) -> list[float]:
        """When each keyframe is passed, in seconds from the first."""
        return list(accumulate(self.legs))

    @property
    def seconds(self) -> float:
        """How long the path takes."""
        return sum(self.legs, 0.0)

    def insert(self, number: int, keyframe: Keyframe) -> None:
        """Put a keyframe at this place of the list.

        Raises:
            InputError: the path is full.
        """
        if len(self.keyframes) >= limits.MOST_KEYFRAMES:
            raise InputError(f"A path has {limits.MOST_KEYFRAMES} keyframes at most. Save it, then delete some.")
        self._put(
            [*self.keyframes[:number], keyframe, *self.keyframes[number:]],
            [*self.legs[:number], USUAL_SECONDS, *self.legs[number:]],
        )

    def change(self, number: int, keyframe: Keyframe) -> None:
        """Put another camera in the place of a keyframe, at its time."""
        self._put([*self.keyframes[:number], keyframe, *self.keyframes[number + 1 :]], self.legs)

    def set_leg(self, number: int, seconds: float) -> None:
        """Let the camera take so many seconds from the keyframe before to this one; what follows is passed later."""
        self._put(self.keyframes, [*self.legs[:number], seconds, *self.legs[number + 1 :]])

    def move(self, number: int, by: int) -> int:
        """Change places with the keyframe before (`by` = -1) or after (1), where there is one; return the new place."""
        other = number + by
        if not 0 <= other < len(self.keyframes):
            return number
        keyframes = list(self.keyframes)
        keyframes[number], keyframes[other] = keyframes[other], keyframes[number]
        self._put(keyframes, self.legs)
        return other

    def remove(self, number: int) -> None:
        """Take a keyframe away."""
        self._put(
            [*self.keyframes[:number], *self.keyframes[number + 1 :]],
            [*self.legs[:number], *self.legs[number + 1 :]],
        )

    def poses(self) -> Float[Tensor, "keys 3 4"]:
        """Return the cameras to world of the keyframes."""
        return keyframe_poses(self.keyframes, self.around)

    def fovs(self) -> list[float]:
        """Return the vertical fields of view of the keyframes, in radians."""
        return [self._vertical(keyframe_focal(each, self.around)) for each in self.keyframes]

    def curve(self) -> KeyframeCurve | None:
        """Return the curve through the keyframes; None where there are fewer than two.

        Raises:
            InputError: no curve passes through them.
        """
        return KeyframeCurve(self.keyframes, self.around, self.times) if len(self.keyframes) > 1 else None

    def view_at(self, curve: KeyframeCurve, seconds: float) -> tuple[Float[Tensor, "3 4"], float]:
        """Return the camera to world at a time, and its vertical field of view in radians."""
        at = torch.tensor([seconds], dtype=curve.knots.dtype).clamp(0.0, self.seconds)
        return curve.poses(at)[0].float(), self._vertical(float(curve.focal(at)))

    def files(self) -> list[str]:
        """Return the names of the keyframe files of the folder, the newest first."""
        try:
            found = [each for each in self.folder.iterdir() if each.suffix == ENDING and not each.name.startswith(".")]
            ordered = sorted(((each.stat().st_mtime, each.name) for each in found if is_own_file(each)), reverse=True)
        except OSError:  # there is none yet, or somebody is removing it
            return []
        return [name for _, name in ordered if len(name) <= limits.MOST_LETTERS][: limits.MOST_PATHS]

    def load(self, name: str) -> None:
        """Take the keyframes of a file of the folder in place of these.

        Raises:
            InputError: there is no such file, or it is no path in this capture; the keyframes stay.
        """
        if name not in self.files():
            raise InputError(f"There is no keyframe file of this name in {self.folder} any more.")
        keyframes = read_keyframes(self.folder / name)
        if len(keyframes) > limits.MOST_KEYFRAMES:
            raise InputError(
                f"{name} has {len(keyframes)} keyframes, and the page shows {limits.MOST_KEYFRAMES} at most."
            )
        given = [each.time for each in keyframes if each.time is not None]
        even = KeyframeCurve(keyframes, self.around, given)
        times = given or (even.knots * USUAL_SECONDS * (len(keyframes) - 1)).tolist()
        if float(even.poses(even.knots)[:, :, 3].abs().max()) > limits.MOST_COORDINATE:
            raise InputError(f"{name} has a keyframe that is too far away for the page to show.")
        even.focal(even.knots)
        self._put(keyframes, [0.0, *(after - before for before, after in pairwise(times))])

    def save(self) -> Path:
        """Write a file of a new name, and return where it is.

        Raises:
            InputError: there are fewer than two keyframes.
            OSError: it cannot be written.
        """
        with free_name(self.folder, "camera_path", ENDING, limits.MOST_PATHS) as path:
            self.write(path)
        return path

    def write(self, path: Path) -> None:
        """Write the keyframes with their times.

        Raises:
            InputError: there are fewer than two.
            OSError: it cannot be written.
        """
        if len(self.keyframes) < 2:
            raise InputError("A path needs two keyframes or more.")
        timed = zip(self.keyframes, self.times, strict=True)
        write_keyframes(path, [replace(each, time=round(time, 3)) for each, time in timed])

    def _put(self, keyframes: list[Keyframe], legs: list[float]) -> None:
        keyframe_poses(keyframes, self.around)  # what has no top is refused before it is here
        within = [min(max(leg, LEAST_SECONDS), limits.MOST_SECONDS_BETWEEN) for leg in legs]
        self.keyframes, self.legs = keyframes, [0.0, *within[1:]] if within else []

    def _vertical(self, focal: float) -> float:
        return 2 * math.atan(0.5 * self.around.height / focal)


def is_own_file(path: Path) -> bool:
    """Tell whether something is a plain file and no link to elsewhere."""
    return path.is_file() and not path.is_symlink()


def keyframe_in_user_frame(
    position: Float[Tensor, "3"],
    look_at: Float[Tensor, "3"],
    up: Float[Tensor, "3"],
    fov: float,
    record: SceneRecord,
) -> Keyframe:
    """Return a keyframe of a camera in the model's frame.

    `fov` is vertical, in radians. A film has the photographs' shape, not the window's, and keeps this field.
    """
    linear, offset = record.to_user[:3, :3].double(), record.to_user[:3, 3].double()
    shape = float(record.cameras.width[0]) / float(record.cameras.height[0])
    return Keyframe(
        position=_rounded(linear @ position.double() + offset),
        look_at=_rounded(linear @ look_at.double() + offset),
        up=_rounded(normalize(linear @ up.double(), dim=0)),
        fov=round(math.degrees(2 * math.atan(shape * math.tan(fov / 2))), 3),
    )


def _rounded(values: Tensor) -> Point:
    x, y, z = (round(value, 6) for value in values.tolist())
    return x, y, z


@contextmanager
def free_name(folder: Path, stem: str, ending: str, most: int) -> Iterator[Path]:
    """Lend a path with the first number that no file has; names never come from the page.

    An empty file keeps the name, so that of several browsers that save at once each has its own; it goes where the
    block fails.

    Raises:
        OSError: there are `most` such files already (more clicks would fill the disk), or it cannot be made.
    """
    path = _made(folder, stem, ending, most)
    try:
        yield path
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def _made(folder: Path, stem: str, ending: str, most: int) -> Path:
    make_folder(folder)
    for number in range(1, most + 1):
        path = folder / f"{stem}_{number:03d}{ending}"
        with suppress(FileExistsError):
            path.touch(exist_ok=False)
            return path
    raise OSError(f"{folder} holds {most} of them, the most that the page writes")


def not_saved(error: OSError) -> str:
    """Return what to tell a person whose file could not be written."""
    return f"It could not be saved: {error}. Make room, or start again with another paths.output_dir=DIR."

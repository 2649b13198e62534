"""Read and write keyframe files: cameras chosen by the user, as yaml that can be written by hand.

keyframes:
- position: [4.0, 0.0, 2.0]   # in the frame and the units of the capture's own files
  look_at: [0.0, 0.0, 0.5]    # a point
  up: [0.0, 0.0, 1.0]         # where the picture's top points; left out: the capture's up
  fov: 40.0                   # degrees across the width; left out: as the photographs
  time: 0.0                   # seconds; in all keyframes or in none (none: at about one speed)

A file has two keyframes or more.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from reprlib import repr as brief
from typing import Any

import yaml

from nerf_lightning.files.atomic import whole_file
from nerf_lightning.files.yaml_files import read_plain_yaml
from nerf_lightning.messages.errors import InputError
from nerf_lightning.video.paths.base import is_number, is_point

Point = tuple[float, float, float]
POINTS = ("position", "look_at", "up")
NUMBERS = ("fov", "time")
CURE = "Check path.file; a keyframe file is a plain list of cameras, without references."


@dataclass(frozen=True)
class Keyframe:
    """One chosen camera, as in the file (above)."""

    position: Point
    look_at: Point
    up: Point | None = None
    fov: float | None = None
    time: float | None = None

    @property
    def ahead(self) -> Point:
        """The direction in which it looks, of any length."""
        x, y, z = (to - at for to, at in zip(self.look_at, self.position, strict=True))
        return x, y, z


def write_keyframes(path: Path, keyframes: Sequence[Keyframe]) -> None:
    """Write a keyframe file, whole or not at all; None values are left out."""
    listed = [
        {key: list(value) if key in POINTS else value for key, value in asdict(each).items() if value is not None}
        for each in keyframes
    ]
    with whole_file(path) as part:
        part.write_text(yaml.safe_dump({"keyframes": listed}, sort_keys=False, default_flow_style=None))


def read_keyframes(path: Path) -> list[Keyframe]:
    """Read a keyframe file of two keyframes or more."""
    try:
        keyframes = _keyframes(read_plain_yaml(path, CURE), path)
    except ValueError as error:  # Python refuses to print integers of thousands of digits
        raise InputError(f"{path} holds a number that cannot be read ({error}). {CURE}") from error
    if len(keyframes) < 2:
        raise InputError(
            f"{path} has {len(keyframes)} keyframe(s), and a path needs two. Add more; for a camera that stays, give "
            "the same one twice."
        )
    _check_times(path, keyframes)
    return keyframes


def _keyframes(content: Any, path: Path) -> list[Keyframe]:
    found = content.get("keyframes") if isinstance(content, dict) else content
    if not isinstance(found, list):
        raise InputError(
            f"{path} has no list of keyframes. Write `keyframes:` and under it one `- position: [x, y, z]` "
            "with a look_at for each camera."
        )
    return [_keyframe(each, f"{path}, keyframe {number}") for number, each in enumerate(found, start=1)]


def _keyframe(content: Any, where: str) -> Keyframe:
    known = (*POINTS, *NUMBERS)
    if not isinstance(content, dict) or not content:
        raise InputError(f"{where} is {brief(content)}, but must name a position and a look_at.")
    unknown = [key for key in content if key not in known]
    if unknown:
        raise InputError(f"{where} has the unknown key {brief(unknown[0])}. It may have {', '.join(known)}.")
    for key, value in content.items():
        if key in POINTS and not is_point(value):
            raise InputError(f"{where}: {key} is {brief(value)}, but must be three finite numbers, [x, y, z].")
        if key in NUMBERS and not is_number(value):
            raise InputError(f"{where}: {key} is {brief(value)}, but must be a finite number.")
    if "position" not in content or "look_at" not in content:
        raise InputError(f"{where} must have a position and a look_at.")
    if not 0 < content.get("fov", 90) < 180:
        raise InputError(f"{where}: fov must be between 0 and 180 degrees.")
    values: dict[str, Any] = {key: tuple(map(float, content[key])) for key in POINTS if key in content}
    values |= {key: float(content[key]) for key in NUMBERS if key in content}
    found = Keyframe(**values)
    if found.ahead == (0, 0, 0) or found.up == (0, 0, 0):
        raise InputError(f"{where} looks nowhere: its up has no length, or look_at is its position.")
    return found


def _check_times(path: Path, keyframes: Sequence[Keyframe]) -> None:
    times = [each.time for each in keyframes if each.time is not None]
    if times and len(times) < len(keyframes):
        raise InputError(f"{path}: {len(times)} of {len(keyframes)} keyframes have a time. Give it to all or to none.")
    for number, (before, after) in enumerate(pairwise(times), start=2):
        if after <= before:
            raise InputError(
                f"{path}, keyframe {number}: its time {after:g} does not follow {before:g}. Times increase."
            )

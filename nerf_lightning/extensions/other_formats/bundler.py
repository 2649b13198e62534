"""Bundler's `bundle.out` (also of RealityScan and Metashape) next to a list of the pictures."""

import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import torch

from nerf_lightning.data.captures.capture import Capture
from nerf_lightning.data.captures.checks import pose_from_matrix
from nerf_lightning.extensions.other_formats.posed import (
    Format,
    Intrinsics,
    Pose,
    Posed,
    PosedReader,
    Size,
    from_world_to_camera,
    sparse_points,
)
from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.regular import encoding_of, open_regular, read_lines, read_text
from nerf_lightning.files.signatures import file_with
from nerf_lightning.messages.errors import InputError

CURE = "Export it again."
LISTS = ("list.txt", "*list*.txt", "*.txt")
"""Of the pictures, the likeliest first."""
FOCAL = re.compile(r"[-+.\deE]+")
"""What may follow a name and 0 in such a list."""


def _read(reader: PosedReader, path: Path) -> Capture:
    """Read the cameras with a focal length; others have no pose. The principal point is the picture's center.

    A pose is world to camera with axes right, up, back.
    """
    names = _names(path)
    with open_regular(path, None) as file:
        lines = (line for line in read_lines(file, encoding_of(file)) if not line.startswith("#") and line.strip())
        count, points = (int(number) for number in _numbers(lines, 1, 2, path))
        require_within("views", count, path, "views")
        require_within("points", points, path, "points")
        cameras = [_numbers(lines, 5, 15, path) for _ in range(count)]
        found = [_numbers(islice(lines, 3), 1, 3, path) for _ in range(points)]
    if count != len(names):
        raise InputError(
            f"{path} has {count} cameras, but the list next to it names {len(names)} pictures. Export both again."
        )
    posed = {f"camera {number}": pair for number, pair in enumerate(zip(names, cameras, strict=True)) if pair[1][0]}
    capture = reader.posed(path, posed, _posed, path.parent, points=sparse_points(found, path))
    capture.left_out.without_pose = tuple(name for name, numbers in zip(names, cameras, strict=True) if not numbers[0])
    return capture


def _names(path: Path) -> list[str]:
    found = next((name for pattern in LISTS if (name := file_with(path.parent, (pattern, "")))), None)
    if found is None:
        raise InputError(f"{path} of Bundler needs a list of its pictures next to it, such as list.txt.")
    lines = read_text(path.parent / found, "text", CURE).splitlines()
    return [_name(line.strip()) for line in lines if line.strip()]


def _name(line: str) -> str:
    """Return the name of a picture in a line of a list, without a following 0 and focal length."""
    words = line.rsplit(maxsplit=2)
    if len(words) == 3 and words[1] == "0" and FOCAL.fullmatch(words[2]):
        return words[0]
    return line.rsplit(maxsplit=1)[0] if len(words) > 1 and words[-1] == "0" else line


def _numbers(lines: Iterator[str], rows: int, count: int, path: Path) -> list[float]:
    """Return `count` numbers from the next `rows` lines."""
    words = " ".join(islice(lines, rows)).split()
    try:
        if len(words) == count:
            return [float(word) for word in words]
    except ValueError:
        pass
    raise InputError(f"{path} ends early, or holds {' '.join(words)[:80]!r} where {count} numbers belong. {CURE}")


def _posed(item: tuple[str, list[float]], where: str) -> Posed:
    name, (focal, k1, k2, *pose) = item

    def camera(size: Size) -> tuple[Pose, Intrinsics]:
        rotation, shift = (
            torch.tensor(pose[:9], dtype=torch.float64).reshape(3, 3),
            torch.tensor(pose[9:], dtype=torch.float64),
        )
        w2c = pose_from_matrix(torch.cat([rotation, shift[:, None]], dim=1), where)
        ahead = w2c * w2c.new_tensor([[1.0], [-1.0], [-1.0]])  # with axes right, down, ahead
        middle = size[0] / 2, size[1] / 2
        return from_world_to_camera(ahead, where), Intrinsics(
            (focal, focal), middle, size, "radial_tangential", (k1, k2, 0.0, 0.0, 0.0, 0.0)
        )

    return Posed(name, where, camera)


FORMAT = Format("Bundler", (("*.out", r"\A# Bundle file"),), _read)

"""Captures with a text file of numbers per pose: NSVF's `pose/`, and NeRF++'s `train/pose` and `test/pose`.

Poses are camera to world, axes right, down, forward.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.data.captures.capture import Capture, View
from nerf_lightning.data.captures.checks import pose_from_matrix
from nerf_lightning.data.captures.find_pictures import PICTURE_FOLDERS, first_with_pictures, pictures_by_stem
from nerf_lightning.data.captures.left_out import LeftOut
from nerf_lightning.data.captures.reader import CaptureReader
from nerf_lightning.data.pixels.decoded_photographs import Photograph
from nerf_lightning.data.pixels.picture_files import read_header
from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.regular import read_text
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.poses import flip_yz

CURE = "Copy it again."
NSVF_SPLITS = {"0": "train", "1": "val", "2": "test"}
"""By the first character of a picture's name, as in 0_train_0001.png."""
NERFPP_SPLITS = {"train": "train", "validation": "val", "val": "val", "test": "test"}


@dataclass
class NsvfReader(CaptureReader):
    """Read an NSVF capture: `intrinsics.txt`, `bbox.txt`, `pose/` and `rgb/`; a name's first digit is its split."""

    name: str = "nsvf"

    @classmethod
    def found_in(cls, folder: Path) -> str | None:
        """Return the file by which this format is recognized, if a folder has it."""
        return "intrinsics.txt" if (folder / "intrinsics.txt").is_file() and (folder / "pose").is_dir() else None

    def capture(self) -> Capture:
        """Return the photographs, sorted by name."""
        root = self.folder()
        left_out = LeftOut(str(root / "pose"))
        views = list(_views(root, "", left_out))
        left_out.require_enough(len(views))
        splits = {
            split: tuple(number for number, view in enumerate(views) if view.name.startswith(f"{digit}_"))
            for digit, split in NSVF_SPLITS.items()
        }
        all_named = sum(map(len, splits.values())) == len(views) and splits["train"]
        return Capture(
            tuple(views), root / "pose", splits=splits if all_named else None, box=_box(root), left_out=left_out
        )


@dataclass
class NerfPlusPlusReader(CaptureReader):
    """Read a NeRF++ capture: `rgb/`, `pose/` and `intrinsics/` in each of `train`, `validation` and `test`."""

    name: str = "nerfpp"

    @classmethod
    def found_in(cls, folder: Path) -> str | None:
        """Return the folder by which this format is recognized, if a folder has it."""
        there = all((folder / "train" / part).is_dir() for part in ("intrinsics", "pose"))
        return "train/intrinsics" if there else None

    def capture(self) -> Capture:
        """Return the photographs of train, validation and test."""
        root = self.folder()
        left_out, views, splits = LeftOut(str(root)), list[View](), dict[str, tuple[int, ...]]()
        for name, split in NERFPP_SPLITS.items():
            start = len(views)
            views += _views(root / name, f"{name}/", left_out)
            splits[split] = (*splits.get(split, ()), *range(start, len(views)))
        left_out.require_enough(len(views))
        return Capture(tuple(views), root, splits=splits, left_out=left_out)


def _views(folder: Path, prefix: str, left_out: LeftOut) -> Iterator[View]:
    """Yield the views of a folder with `pose/`, photographs, and intrinsics for each or for all."""
    place = first_with_pictures(folder, [name for name in PICTURE_FOLDERS if name])
    pictures = {} if place is None else pictures_by_stem(place)
    require_within("views", len(pictures), folder, "views")
    for pose in sorted((folder / "pose").glob("[!.]*.txt")):
        with left_out.unless_usable(prefix + pose.stem):
            if pose.stem not in pictures:
                raise InputError(f"{folder} holds no photograph of the pose {pose.name}. Copy it there.")
    for stem, picture in pictures.items():
        name = picture.name
        with left_out.unless_usable(prefix + name):
            pose, own = folder / "pose" / f"{stem}.txt", folder / "intrinsics" / f"{stem}.txt"
            intrinsics = first_numbers(own if own.is_file() else folder / "intrinsics.txt")
            header = read_header(picture)
            (fx, fy, cx, cy), size = intrinsics_of(intrinsics, header.size)
            yield View(
                name=prefix + name,
                photograph=Photograph(picture, header=header),
                c2w=flip_yz(pose_from_matrix(first_numbers(pose)[:16], str(pose))),
                focal=(fx, fy),
                center=(cx, cy),
                size=size,
            )


def intrinsics_of(
    numbers: list[float], size: tuple[int, int]
) -> tuple[tuple[float, float, float, float], tuple[float, float]]:
    """Return fx, fy, cx, cy, and the (width, height) that they are for: the picture's if none is given.

    The numbers are a matrix of 4 x 4 or 3 x 3; fx, fy, cx, cy; or NSVF's f, cx, cy and others, with height and width
    at the end.
    """
    as_it_is = (float(size[0]), float(size[1]))
    if len(numbers) == 4 and numbers[3]:
        return (numbers[0], numbers[1], numbers[2], numbers[3]), as_it_is
    if len(numbers) == 11:
        return (numbers[0], numbers[0], numbers[1], numbers[2]), (numbers[10], numbers[9])
    if len(numbers) >= 16 or len(numbers) == 9:
        across = 4 if len(numbers) >= 16 else 3
        return (numbers[0], numbers[across + 1], numbers[2], numbers[across + 2]), as_it_is
    return (numbers[0], numbers[0], numbers[1], numbers[2]), as_it_is


def first_numbers(path: Path) -> list[float]:
    """Return the first numbers of a text file, at least three; lines that begin with # are skipped."""
    found = list[float]()
    lines = [line for line in read_text(path, "text", CURE).splitlines() if not line.startswith("#")]
    for word in " ".join(lines).replace(",", " ").split():
        try:
            found.append(float(word))
        except ValueError:
            break
    if len(found) < 3:
        raise InputError(f"{path} does not begin with the numbers that belong there. {CURE}")
    return found


def _box(root: Path) -> Float[Tensor, "2 3"] | None:
    """Return the corners in `bbox.txt`, if it exists."""
    if not (root / "bbox.txt").is_file():
        return None
    numbers = torch.tensor(first_numbers(root / "bbox.txt")[:6], dtype=torch.float64)
    return (
        numbers.reshape(2, 3).sort(dim=0).values if len(numbers) == 6 and bool(torch.isfinite(numbers).all()) else None
    )

"""The files of a COLMAP model (colmap.github.io/format.html), binary or text: cameras, photographs, sparse points.

They are parsed here: COLMAP's own library hangs on some truncated ones. The caller catches what damaged files raise
(`files.trust.reading`).

How far a point's distance is trusted: `captures/known_depths.py`.
"""

import logging
import math
import mmap
import os
import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from nerf_lightning.data.readers.colmap_cameras import BY_NUMBER, CAMERA_MODELS, ColmapCamera
from nerf_lightning.files.budgets import limits, require_within
from nerf_lightning.files.regular import encoding_of, open_regular, read_lines
from nerf_lightning.files.trust import reading
from nerf_lightning.messages.errors import InputError

WINDOWS = "cp1252"
LONGEST_NAME = 1 << 14
"""In bytes."""
MOST_TRACKS, LONGEST_TRACK = 500_000, 1000
"""Maximum number of evenly spread points whose tracks are read (up to `budgets.points` entries), and of photographs per
track."""
CURE = "Copy the model again, or run the reconstruction again (nerf poses images=DIR)."
CURE_MODEL = "The file is damaged, or of a newer COLMAP: reconstruct with the camera model OPENCV, or undistort first."

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ColmapImage:
    """One registered photograph."""

    number: int
    name: str
    camera: int
    rotation: tuple[float, float, float, float]
    """World to camera, as a quaternion w, x, y, z."""
    translation: tuple[float, float, float]


@dataclass(frozen=True)
class ColmapPoints:
    """The sparse points, and where they were seen."""

    positions: Float[ndarray, "points 3"]
    errors: Float[ndarray, "points"]
    """Mean reprojection error in pixels; -1 or NaN if unknown."""
    tracks: Int[ndarray, "seen 2"]
    """Row of a point, and ID of a photograph in which it was seen."""

    @classmethod
    def of(cls, rows: Float[ndarray, "points 4"], images: ndarray, lengths: ndarray) -> "ColmapPoints":
        """Return the points of rows (x, y, z, error), whose tracks are concatenated."""
        point = np.repeat(np.arange(len(rows)), lengths)
        return cls(rows[:, :3].copy(), rows[:, 3].copy(), np.stack([point, images.astype(np.int64)], axis=1))


class BinaryFiles:
    """Parse cameras.bin, images.bin and points3D.bin: little-endian records; each list is preceded by its length."""

    def cameras(self, path: Path) -> Iterator[ColmapCamera]:
        """Return the cameras."""
        data = _Bytes(path)
        for _ in range(data.count(24, "views")):
            number, model, width, height = data.take("<IiQQ")
            if model not in BY_NUMBER:
                raise InputError(f"{path} holds a camera of the unknown model number {model}. {CURE_MODEL}")
            name = BY_NUMBER[model]
            yield ColmapCamera(number, name, width, height, data.take(f"<{CAMERA_MODELS[name].num_params}d"))
        data.end()

    def images(self, path: Path) -> Iterator[ColmapImage]:
        """Return the photographs; their features are skipped."""
        data = _Bytes(path)
        for _ in range(data.count(73, "views")):
            values = data.take("<I7dI")
            name = data.text()
            data.skip(24 * data.take("<Q")[0])
            yield ColmapImage(values[0], name, values[8], values[1:5], values[5:8])
        data.end()

    def number_of_images(self, path: Path) -> int:
        """Return the number of photographs that a file announces."""
        return _Bytes(path).count(73, "views")

    def points(self, path: Path) -> ColmapPoints:
        """Return the sparse points."""
        data, found, tracks = _Bytes(path), array("d"), [np.zeros(0, "<u4")]
        left = limits().points
        count = data.count(51, "points")
        lengths, stride = np.zeros(count, np.int64), 1 + count // MOST_TRACKS
        for number in range(count):
            _, x, y, z, _, _, _, error, length = data.take("<Q3d3BdQ")
            found.extend((x, y, z, error))
            if number % stride or length > min(LONGEST_TRACK, left):
                data.skip(8 * length)
            else:
                tracks.append(data.numbers("<u4", 2 * length)[::2])
                lengths[number] = length
                left -= length
        data.end()
        return ColmapPoints.of(np.frombuffer(found, np.float64).reshape(-1, 4), np.concatenate(tracks), lengths)


class _Bytes:
    """A file's bytes, read in order."""

    def __init__(self, path: Path):
        self.path, self.offset = path, 0
        self.data: bytes | mmap.mmap
        with open_regular(path, "colmap", CURE) as file:
            # Mapped: most of the file is skipped (features, tracks) and need not be in memory.
            empty = os.fstat(file.fileno()).st_size == 0
            self.data = b"" if empty else mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)

    def take(self, form: str) -> tuple:
        values = struct.unpack_from(form, self.data, self.offset)
        self.skip(struct.calcsize(form))
        return values

    def count(self, least_bytes: int, budget: str) -> int:
        """Return the length of a list whose entries take at least `least_bytes` bytes."""
        count = int(self.take("<Q")[0])
        if count * least_bytes > len(self.data) - self.offset:
            raise ValueError(f"it claims {count:,} entries, but has {len(self.data)} bytes")
        require_within(budget, count, self.path, budget)
        return count

    def numbers(self, kind: str, count: int) -> ndarray:
        """Return a copy of `count` numbers of one kind."""
        numbers = np.frombuffer(self.data, kind, count, self.offset).copy()
        self.skip(numbers.nbytes)
        return numbers

    def skip(self, size: int) -> None:
        self.offset += size

    def text(self) -> str:
        end = self.data.find(b"\0", self.offset, self.offset + LONGEST_NAME)
        if end < 0:
            raise ValueError(f"it ends within a name, or has one of more than {LONGEST_NAME:,} bytes")
        name, self.offset = self.data[self.offset : end], end + 1
        try:
            return name.decode("utf-8")
        except UnicodeDecodeError:
            _say_of_encoding(self.path)
            return name.decode(WINDOWS, "replace")

    def end(self) -> None:
        if self.offset != len(self.data):
            raise ValueError(f"it claims {self.offset:,} bytes, but has {len(self.data):,}")


class TextFiles:
    """Parse cameras.txt, images.txt and points3D.txt: lines of words; comments begin with #."""

    def cameras(self, path: Path) -> Iterator[ColmapCamera]:
        """Return the cameras."""
        for where, line in _within(_lines(path), "views", path):
            with reading(where, CURE):
                number, model, width, height, *params = line.split()
                model = model.upper()
                if model not in CAMERA_MODELS:
                    raise InputError(f"{where} holds a camera of the unknown model {model!r}. {CURE_MODEL}")
                if len(params) != (count := CAMERA_MODELS[model].num_params):
                    raise ValueError(f"{model} has {count} parameters, not {len(params)}")
                sides = int(float(width)), int(float(height))
                yield ColmapCamera(int(number), model, *sides, tuple(map(float, params)))

    def images(self, path: Path) -> Iterator[ColmapImage]:
        """Return the photographs, each of which has two lines; the second one, with its features, may be empty."""
        lines = _lines(path, keep_empty=True)
        # Like COLMAP, skip empty lines before a photograph, but not where features are due.
        for where, line in _within(((where, line) for where, line in lines if line), "views", path):
            with reading(where, CURE):
                number, *numbers, camera, name = line.split(maxsplit=9)
                qw, qx, qy, qz, x, y, z = map(float, numbers)
                # If the lines of features are missing, every second photograph would be mistaken for one.
                features = next(lines, ("", ""))[1].split()
                if len(features) % 3 or (features and int(features[-1]) < -1):
                    raise ValueError("the next line must hold features (x, y, number of the point), or be empty")
                yield ColmapImage(int(number), name, int(camera), (qw, qx, qy, qz), (x, y, z))

    def number_of_images(self, path: Path) -> int:
        """Return the number of photographs in a file."""
        return sum(1 for _ in self.images(path))

    def points(self, path: Path) -> ColmapPoints:
        """Return the sparse points."""
        found, tracks, lengths = array("d"), array("q"), array("q")
        for where, line in _within(_lines(path), "points", path):
            with reading(where, CURE):
                words = line.split(maxsplit=8 + 2 * LONGEST_TRACK)
                x, y, z = map(float, words[1:4])
                found.extend((x, y, z, float(words[7]) if len(words) > 7 else math.nan))
                last = 8 + 2 * min(LONGEST_TRACK, limits().points - len(tracks))
                track = [int(image) for image in words[8:last:2] if image.isdecimal()]
            tracks.extend(track)
            lengths.append(len(track))
        numbers = (np.frombuffer(each, np.int64) for each in (tracks, lengths))
        return ColmapPoints.of(np.frombuffer(found, np.float64).reshape(-1, 4), *numbers)


def _lines(path: Path, keep_empty: bool = False) -> Iterator[tuple[str, str]]:
    """Yield each line with its location, one at a time: a file of empty lines is small only on disk."""
    with open_regular(path, "colmap", CURE) as file:
        encoding = encoding_of(file)
        has_names = keep_empty and encoding == "utf-8-sig"
        lines = read_lines(file, encoding, "surrogateescape" if has_names else "strict")
        for number, line in enumerate(lines, start=1):
            if not line.startswith("#") and (keep_empty or line.strip()):
                yield f"{path}, line {number}", (line if line.isascii() else _with_names(line, path)).strip()


def _with_names(line: str, path: Path) -> str:
    """Return a line that may have bytes which are not UTF-8: they are decoded as Windows encodes names."""
    try:
        line.encode()
        return line
    except UnicodeEncodeError:
        _say_of_encoding(path)
        return line.encode(errors="surrogateescape").decode(WINDOWS)


@cache
def _say_of_encoding(path: Path) -> None:
    log.warning("%s is not UTF-8: its names are read in the encoding of Windows (%s)", path, WINDOWS)


def _within(lines: Iterator[tuple[str, str]], budget: str, path: Path) -> Iterator[tuple[str, str]]:
    """Yield the lines, and refuse more than a budget allows: a text file does not announce its length."""
    most = getattr(limits(), budget)
    for number, line in enumerate(lines):
        if number == most:
            require_within(budget, math.inf, path, budget)
        yield line

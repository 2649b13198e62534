"""The text files of a COLMAP model: lines of words; comments begin with #."""

import io
from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from nerf_lightning.data.readers.colmap.records import CURE, CURE_MODEL, MODELS, MOST_BYTES, ColmapCamera, ColmapImage
from nerf_lightning.files.budgets import allowed
from nerf_lightning.files.regular import open_regular
from nerf_lightning.messages.errors import InputError

COUNTS = dict(MODELS.values())
LONGEST_LINE = 1 << 24
"""In characters; that of a photograph with a hundred thousand features takes less."""


class TextFiles:
    """Parse cameras.txt, images.txt and points3D.txt."""

    def cameras(self, path: Path) -> Iterator[tuple[int, ColmapCamera]]:
        """Return the cameras with their numbers."""
        for number, line in _lines(path):
            where, words = f"{path}, line {number}", line.split()
            model = words[1] if len(words) > 1 else ""
            if model not in COUNTS:
                raise InputError(f"{where} holds a camera of the unknown model {model!r}. {CURE_MODEL}")
            width, height, *params = _numbers(words[2:], where, 2 + COUNTS[model])
            size = _whole(width, where), _whole(height, where)
            yield _whole(_numbers(words[:1], where, 1)[0], where), ColmapCamera(model, *size, tuple(params))

    def images(self, path: Path) -> Iterator[ColmapImage]:
        """Return the photographs, each of which takes two lines; the second one, with its features, may be empty."""
        lines = _lines(path, keep_empty=True)
        for number, line in lines:
            # COLMAP, too, passes over empty lines here, but not where features are due.
            if not line:
                continue
            where, words = f"{path}, line {number}", line.split(maxsplit=9)
            qw, qx, qy, qz, x, y, z, camera = _numbers(words[1:9], where, 8)
            if len(words) < 10:
                raise InputError(f"{where} lacks the photograph's name. {CURE}")
            _check_features(next(lines, (0, ""))[1].split(), where)
            yield ColmapImage(words[9], _whole(camera, where), (qw, qx, qy, qz), (x, y, z))

    def points(self, path: Path) -> Float[ndarray, "points 3"]:
        """Return the sparse points."""
        found, most = array("d"), allowed().points
        for number, line in _lines(path):
            found.extend(_numbers(line.split(maxsplit=4)[1:4], f"{path}, line {number}", 3))
            if len(found) > 3 * most:  # a text does not say how many there are
                raise InputError(
                    f"{path} has more than {most:,} points, which are not taken from a file unasked. If you trust it, "
                    "add budgets.points=N; else use another file."
                )
        return np.frombuffer(found, np.float64).reshape(-1, 3)


def _lines(path: Path, keep_empty: bool = False) -> Iterator[tuple[int, str]]:
    try:
        # Line by line: a file of empty lines is small on the disk alone.
        with open_regular(path, MOST_BYTES, CURE) as binary, io.TextIOWrapper(binary, "utf-8", newline="\n") as file:
            for number, line in enumerate(iter(lambda: file.readline(LONGEST_LINE + 1), ""), start=1):
                if len(line) > LONGEST_LINE:
                    raise InputError(f"{path}, line {number} has more than {LONGEST_LINE:,} characters. {CURE}")
                if not line.startswith("#") and (keep_empty or line.strip()):
                    yield number, line.strip()
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not a text file (it is not UTF-8). {CURE}") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}. Check its permissions.") from error


def _check_features(words: list[str], where: str) -> None:
    # Where the lines of features are missing, every second photograph would be taken for one.
    try:
        features = len(words) % 3 == 0 and (not words or int(words[-1]) >= -1)
    except ValueError:
        features = False
    if not features:
        raise InputError(
            f"{where}: the line after it must hold the photograph's features (x, y, number of the point) or be empty. "
            f"{CURE}"
        )


def _numbers(words: list[str], where: str, count: int) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count:
        raise InputError(
            f"{where} should hold {count} numbers there, but it holds {' '.join(words) or 'nothing'}. {CURE}"
        )
    return values


def _whole(value: float, where: str) -> int:
    if not value.is_integer():  # neither are NaN and infinity
        raise InputError(f"{where} should hold a whole number where {value:g} stands. {CURE}")
    return int(value)

"""The files of a COLMAP model, binary or text: cameras, images with poses, sparse points.

They are parsed here, every length checked before it is believed, since COLMAP's own library hangs on some truncated
files. The format is documented at colmap.github.io/format.html.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from nerf_lightning.data.checks import listed
from nerf_lightning.errors import InputError

MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
}
FILES = ("cameras", "images", "points3D")
CURE = "Copy the model again, or run the reconstruction anew (nerf poses images=DIR)."


@dataclass(frozen=True)
class ColmapCamera:
    """One camera's intrinsics."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ColmapImage:
    """One registered photograph."""

    name: str
    camera: int
    rotation: tuple[float, float, float, float]
    """World to camera, a quaternion w, x, y, z."""
    translation: tuple[float, float, float]


@dataclass(frozen=True)
class ColmapModel:
    """What the three files say."""

    cameras: dict[int, ColmapCamera]
    images: tuple[ColmapImage, ...]
    """In order of their names."""
    points: Float[ndarray, "points 3"]


def find_model(root: Path) -> Path:
    """Return the folder of the model in a capture: `sparse/0`, `sparse`, or the folder itself.

    Raises:
        InputError: none of them holds one.
    """
    for folder in (root / "sparse" / "0", root / "sparse", root):
        if any((folder / f"cameras{ending}").is_file() for ending in (".bin", ".txt")):
            return folder
    raise InputError(
        f"{root} holds no COLMAP model: there is no cameras.bin or cameras.txt in sparse/0, in sparse, or in the "
        "folder itself. Point scene.root at the folder above sparse/, or make a model with nerf poses images=DIR."
    )


def read_model(folder: Path) -> ColmapModel:
    """Read a model, binary or text.

    Raises:
        InputError: a file is missing, cut short, of an unknown kind, or disagrees with another.
    """
    kinds = [ending for ending in (".bin", ".txt") if (folder / f"cameras{ending}").is_file()]
    models = [_read_kind(folder, ending) for ending in kinds]
    if len(models) == 2 and not _agree(*models):
        raise InputError(
            f"{folder} holds the model twice, and images.bin and images.txt disagree. Remove the files of the older "
            "one (compare their dates)."
        )
    model = models[0]
    if not model.images:
        raise InputError(f"The model in {folder} has no registered photograph, so nothing can be learnt. {CURE}")
    lost = sorted({str(image.camera) for image in model.images} - {str(number) for number in model.cameras})
    if lost:
        raise InputError(f"The images of {folder} name cameras that its cameras file lacks: {listed(lost)}. {CURE}")
    return model


def _read_kind(folder: Path, ending: str) -> ColmapModel:
    paths = [folder / f"{name}{ending}" for name in FILES]
    for path in paths[:2]:
        if not path.is_file():
            raise InputError(f"{folder} holds cameras{ending} but no {path.name}: the model is not whole. {CURE}")
    readers = (_Binary if ending == ".bin" else _Text)(folder)
    images = sorted(readers.images(paths[1]), key=lambda image: image.name)
    twice = sorted({a.name for a, b in pairwise(images) if a.name == b.name})
    if twice:
        raise InputError(f"{paths[1]} holds {listed(twice)} more than once. {CURE}")
    points = readers.points(paths[2]) if paths[2].is_file() else np.zeros((0, 3))
    return ColmapModel(readers.cameras(paths[0]), tuple(images), points)


def _agree(a: ColmapModel, b: ColmapModel) -> bool:
    if [image.name for image in a.images] != [image.name for image in b.images]:
        return False
    pairs = zip(a.images, b.images, strict=True)
    return all(np.allclose(x.translation, y.translation, rtol=1e-4, atol=1e-4) for x, y in pairs)


class _Binary:
    """Little-endian records, each list after its length."""

    def __init__(self, folder: Path):
        self.folder = folder

    def cameras(self, path: Path) -> dict[int, ColmapCamera]:
        data = _Bytes(path)
        found = {}
        for _ in range(data.count(24)):
            number, model, width, height = data.take("<IiQQ")
            if model not in MODELS:
                raise InputError(f"{path} holds a camera of the unknown model number {model}. {CURE}")
            name, count = MODELS[model]
            found[number] = ColmapCamera(name, width, height, data.take(f"<{count}d"))
        return found

    def images(self, path: Path) -> Iterator[ColmapImage]:
        data = _Bytes(path)
        for _ in range(data.count(73)):
            values = data.take("<I7dI")
            name = data.text()
            data.skip(24 * data.take("<Q")[0])
            yield ColmapImage(name, values[8], values[1:5], values[5:8])

    def points(self, path: Path) -> Float[ndarray, "points 3"]:
        data = _Bytes(path)
        found = []
        for _ in range(data.count(51)):
            values = data.take("<Q3d3Bd")
            data.skip(8 * data.take("<Q")[0])
            found.append(values[1:4])
        return np.array(found, np.float64).reshape(-1, 3)


class _Bytes:
    """A file's bytes, taken in order; what is not there is named."""

    def __init__(self, path: Path):
        self.path, self.place = path, 0
        try:
            self.data = path.read_bytes()
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror}. Check its permissions.") from error

    def take(self, form: str) -> tuple:
        size = struct.calcsize(form)
        self._need(size)
        self.place += size
        return struct.unpack_from(form, self.data, self.place - size)

    def count(self, least_bytes: int) -> int:
        """Return the length of a list whose entries take at least so many bytes."""
        (count,) = self.take("<Q")
        self._need(count * least_bytes)
        return int(count)

    def skip(self, size: int) -> None:
        self._need(size)
        self.place += size

    def text(self) -> str:
        end = self.data.find(b"\0", self.place)
        if end < 0:
            self._need(len(self.data) + 1)
        name, self.place = self.data[self.place : end], end + 1
        try:
            return name.decode("utf-8")
        except UnicodeDecodeError as error:
            raise InputError(f"{self.path} holds a file name that is not UTF-8: {name!r}. {CURE}") from error

    def _need(self, size: int) -> None:
        if self.place + size > len(self.data):
            raise InputError(
                f"{self.path} ends after {len(self.data)} bytes, in the middle of what it announces: it was cut short "
                f"or is no such file. {CURE}"
            )


class _Text:
    """Lines of words; comments begin with #."""

    def __init__(self, folder: Path):
        self.folder = folder

    def cameras(self, path: Path) -> dict[int, ColmapCamera]:
        counts = dict(MODELS.values())
        found = {}
        for number, words in _lines(path):
            where = f"{path}, line {number}"
            model = words[1] if len(words) > 1 else ""
            if model not in counts:
                raise InputError(f"{where} holds a camera of the unknown model {model!r}. {CURE}")
            values = _numbers(words[2:], where, 2 + counts[model])
            found[int(_numbers(words[:1], where, 1)[0])] = ColmapCamera(
                model, int(values[0]), int(values[1]), tuple(values[2:])
            )
        return found

    def images(self, path: Path) -> Iterator[ColmapImage]:
        # Each photograph takes two lines, the second of which (its features) may be empty.
        for number, words in list(_lines(path, keep_empty=True))[::2]:
            where = f"{path}, line {number}"
            values = _numbers(words[1:9], where, 8)
            if len(words) < 10:
                raise InputError(f"{where} lacks the photograph's name. {CURE}")
            yield ColmapImage(" ".join(words[9:]), int(values[7]), _four(values), _three(values[4:]))

    def points(self, path: Path) -> Float[ndarray, "points 3"]:
        found = [_numbers(words[1:4], f"{path}, line {number}", 3) for number, words in _lines(path)]
        return np.array(found, np.float64).reshape(-1, 3)


def _lines(path: Path, keep_empty: bool = False) -> Iterator[tuple[int, list[str]]]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read as text: {error}. {CURE}") from error
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.startswith("#") and (keep_empty or line.strip()):
            yield number, line.split()


def _three(values: list[float]) -> tuple[float, float, float]:
    return values[0], values[1], values[2]


def _four(values: list[float]) -> tuple[float, float, float, float]:
    return values[0], values[1], values[2], values[3]


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

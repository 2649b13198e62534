"""A COLMAP model in three files, binary or text: found, parsed, and checked against itself.

The files are parsed here, every length checked before it is believed, since COLMAP's own library hangs on some
truncated ones. The format is documented at colmap.github.io/format.html.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from nerf_lightning.data.readers.colmap.binary import BinaryFiles
from nerf_lightning.data.readers.colmap.records import CURE, ColmapCamera, ColmapImage, ModelFiles
from nerf_lightning.data.readers.colmap.text import TextFiles
from nerf_lightning.files.budgets import allowed
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed

Record = TypeVar("Record")
FILES = ("cameras", "images", "points3D")
KINDS: dict[str, ModelFiles] = {".bin": BinaryFiles(), ".txt": TextFiles()}
# Twins agree to so much, relative and absolute: text may have been written with few digits.
TOLERANCE = 1e-4


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
        if any((folder / f"cameras{ending}").is_file() for ending in KINDS):
            return folder
    raise InputError(
        f"{root} holds no COLMAP model: there is no cameras.bin or cameras.txt in sparse/0, in sparse, or in the "
        "folder itself. Point scene.root at the folder above sparse/, or make a model with nerf poses images=DIR."
    )


def model_files(folder: Path) -> list[Path]:
    """Return the files of the model, of both kinds, that are there."""
    paths = [folder / f"{name}{ending}" for name in FILES for ending in KINDS]
    return [path for path in paths if path.is_file()]


def read_model(folder: Path) -> ColmapModel:
    """Read a model, binary or text.

    Raises:
        InputError: a file is missing, cut short, of an unknown kind, or disagrees with another.
    """
    models = [_read_kind(folder, ending) for ending in KINDS if (folder / f"cameras{ending}").is_file()]
    if len(models) == 2 and not _agree(*models):
        raise InputError(
            f"{folder} holds the model twice, and its binary and its text files disagree. Remove the files of the "
            "older one (compare their dates)."
        )
    model = models[0]
    if not model.images:
        raise InputError(f"The model in {folder} has no registered photograph, so nothing can be learnt. {CURE}")
    lost = sorted({image.camera for image in model.images} - set(model.cameras))
    if lost:
        raise InputError(f"The images of {folder} name cameras that its cameras file lacks: {listed(lost)}. {CURE}")
    return model


def _read_kind(folder: Path, ending: str) -> ColmapModel:
    cameras_path, images_path, points_path = (folder / f"{name}{ending}" for name in FILES)
    if not images_path.is_file():
        raise InputError(f"{folder} holds {cameras_path.name} but no {images_path.name}: it is not whole. {CURE}")
    files = KINDS[ending]
    cameras = _no_more_than_allowed(files.cameras(cameras_path), cameras_path)
    images = _no_more_than_allowed(files.images(images_path), images_path)
    _once((number for number, _ in cameras), cameras_path)
    _once((image.name for image in images), images_path)
    if any(not image.name for image in images):
        raise InputError(f"{images_path} holds a photograph without a name. {CURE}")
    points = files.points(points_path) if points_path.exists() else np.zeros((0, 3))
    return ColmapModel(dict(cameras), tuple(sorted(images, key=lambda image: image.name)), points)


def _no_more_than_allowed(records: Iterator[Record], path: Path) -> list[Record]:
    # A text does not say how many there are: it is read no further than that.
    most = allowed().views
    kept = list(islice(records, most + 1))
    if len(kept) > most:
        raise InputError(
            f"{path} has more than {most:,} views, which are not taken from a file unasked. If you trust it, add "
            "budgets.views=N; else use another file."
        )
    return kept


def _once(keys: Iterable[object], path: Path) -> None:
    twice = [key for key, count in Counter(keys).items() if count > 1]
    if twice:
        raise InputError(f"{path} holds {listed(twice)} more than once. {CURE}")


def _agree(a: ColmapModel, b: ColmapModel) -> bool:
    if [image.name for image in a.images] != [image.name for image in b.images]:
        return False
    return all(
        _alike(_numbers_of(x, a.cameras), _numbers_of(y, b.cameras)) for x, y in zip(a.images, b.images, strict=True)
    )


def _numbers_of(image: ColmapImage, cameras: dict[int, ColmapCamera]) -> list[float]:
    camera = cameras.get(image.camera)
    intrinsics = (float(camera.width), float(camera.height), *camera.params) if camera else ()
    # A quaternion and its negative are one rotation, and have the same products.
    return [*np.outer(image.rotation, image.rotation).ravel().tolist(), *image.translation, *intrinsics]


def _alike(a: list[float], b: list[float]) -> bool:
    return len(a) == len(b) and bool(np.allclose(a, b, rtol=TOLERANCE, atol=TOLERANCE))

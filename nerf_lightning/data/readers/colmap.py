"""COLMAP reconstructions: a model in `sparse/0` (or `sparse`), binary or text, next to a folder of photographs.

Which views are held out: `hold_every` in conf/scene_defaults.yaml. Camera models: `colmap_cameras.py`.
"""

import logging
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from nerf_lightning.data.captures.capture import Capture, View, of_one_lens
from nerf_lightning.data.captures.find_pictures import (
    PICTURE_FOLDERS,
    find_pictures,
    pictures_below,
    why_absent,
)
from nerf_lightning.data.captures.left_out import LeftOut
from nerf_lightning.data.captures.reader import CaptureReader
from nerf_lightning.data.pixels.decoded_photographs import Photograph
from nerf_lightning.data.readers.colmap_cameras import ColmapCamera, intrinsics_of, lens_of
from nerf_lightning.data.readers.colmap_files import CURE, BinaryFiles, ColmapImage, ColmapPoints, TextFiles
from nerf_lightning.data.readers.ply_points import read_ply_points
from nerf_lightning.files.regular import what_is
from nerf_lightning.files.trust import reading
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.geometry.poses import flip_yz, rotation_from_quaternion

MODEL_FOLDERS = ("sparse", "", "colmap/sparse", "colmap", "colmap_text", "distorted/sparse")
"""Folders with models, or with folders of models, below a capture's folder, the likeliest first."""
FILES = ("cameras", "images", "points3D")
KINDS: dict[str, BinaryFiles | TextFiles] = {".bin": BinaryFiles(), ".txt": TextFiles()}
NO_POINTS = ColmapPoints(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2), np.int64))
PLY = "points3D.ply"

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ColmapModel:
    """The content of the three files."""

    cameras: dict[int, ColmapCamera]
    images: tuple[ColmapImage, ...]
    """Sorted by name."""
    points: ColmapPoints


@dataclass
class ColmapReader(CaptureReader):
    """Read a COLMAP model, binary or text, with one camera for all photographs or one for each.

    Args:
        images: the folder of the photographs below root, or of a downscaled copy such as images_4. null: images, input
            or another common one whose files match the model's names.
        model: the folder of the model below root. null: of the usual places, the model with the most photographs.
    """

    name: str = "colmap"
    images: str | None = None
    model: str | None = None

    @classmethod
    def found_in(cls, folder: Path) -> str | None:
        """Return the model by which this format is recognized, if a folder has one."""
        found = models_in(folder)
        return next((model.relative_to(folder).as_posix() for model in found), None)

    def capture(self) -> Capture:
        """Return the registered photographs, sorted by name."""
        root = self.folder()
        folder = self._model(root)
        model = read_model(folder)
        names, left_out = [image.name for image in model.images], LeftOut(str(folder))
        where = self.top() if self.images is None else self.below(self.images)
        if not os.path.isdir(where):
            raise InputError(f"{where} {what_is(where)}. Set scene.images to the photographs' folder below {root}.")
        usual = (
            [where] if self.images else [root / name for name in (*_photograph_folders(folder, root), *PICTURE_FOLDERS)]
        )
        pictures = next((place for place in usual if os.path.isdir(place)), where)
        files = find_pictures(names, pictures, where, folder, self.allow_outside)
        views, kept, lenses = [], [], []
        for image in model.images:
            with left_out.unless_usable(image.name):
                if image.name not in files:
                    raise InputError(f"The model in {folder}: {why_absent(image.name, pictures, where)}")
                camera = model.cameras.get(image.camera)
                if camera is None:
                    raise InputError(
                        f"{folder}: {image.name} names a camera that does not exist: {image.camera}. {CURE}"
                    )
                lens = lens_of(camera, folder)
                views.append(_view(image, camera, files[image.name]))
                kept.append(image)
                lenses.append(lens)
        left_out.require_enough(len(views))
        taken = set(files.values())
        base = os.path.commonpath([path.parent for path in taken])
        others = [path for path in pictures_below(Path(base)) if path not in taken] if self._own(base) else []
        left_out.without_pose = tuple(path.relative_to(base).as_posix() for path in others)
        capture = Capture(
            views=tuple(views),
            source=folder,
            points=torch.from_numpy(model.points.positions),
            point_errors=torch.from_numpy(model.points.errors),
            tracks=torch.from_numpy(_tracks(kept, model.points)),
            left_out=left_out,
        )
        return of_one_lens(capture, lenses)

    def _own(self, folder: str) -> bool:
        """Return whether a folder contains only photographs, not all kinds of pictures."""
        return Path(folder) not in (self.folder(), self.top()) and Path(folder).is_relative_to(self.top())

    def _model(self, root: Path) -> Path:
        if self.model is not None:
            return self.below(self.model)
        found = models_in(root)
        if not found:
            places = listed(filter(None, MODEL_FOLDERS), len(MODEL_FOLDERS))
            raise InputError(
                f"{root} holds no COLMAP model: there is no cameras.bin or cameras.txt in {places}, or in the folder "
                "itself. Point scene.root at the folder above sparse/, or make a model with nerf poses images=DIR."
            )
        first, *others = found
        if others:
            log.info(
                "%s is read, with %d photographs, of %d models; scene.model=FOLDER reads another (%s)",
                *(first, found[first], len(found)),
                listed((f"{model.relative_to(root)}: {found[model]}" for model in others), 3),
            )
        return first


def _view(image: ColmapImage, camera: ColmapCamera, path: Path) -> View:
    focal, center, lens = intrinsics_of(camera)
    return View(
        name=image.name,
        photograph=Photograph(path),
        c2w=_c2w(image),
        focal=focal,
        center=center,
        size=(float(camera.width), float(camera.height)),
        lens=lens,
    )


def _photograph_folders(model: Path, root: Path) -> tuple[str, ...]:
    """Return the folder of photographs that belongs to a model's folder, to be tried before the usual ones."""
    return ("input",) if "distorted" in model.relative_to(root).parts else ()


def _tracks(images: Sequence[ColmapImage], points: ColmapPoints) -> Int[ndarray, "seen 2"]:
    """Return which point was seen in which photograph, by row; unknown photographs are left out."""
    if not images:
        return np.zeros((0, 2), np.int64)
    numbers = np.array([image.number for image in images])
    order = np.argsort(numbers)
    point, seen = points.tracks.T
    row = np.searchsorted(numbers[order], seen).clip(max=len(numbers) - 1)
    known = numbers[order][row] == seen
    return np.stack([point[known], order[row[known]]], axis=1)


def _c2w(image: ColmapImage) -> Float[Tensor, "3 4"]:
    """Invert world-to-camera with axes right, down, forward into camera-to-world with axes right, up, back."""
    rotation = rotation_from_quaternion(torch.tensor(image.rotation, dtype=torch.float64))
    translation = torch.tensor(image.translation, dtype=torch.float64)
    center = -rotation.mT @ translation
    return flip_yz(torch.cat([rotation.mT, center[:, None]], dim=-1))


def models_in(root: Path) -> dict[Path, int]:
    """Return the folders of a capture's models and, if there are several, their numbers of photographs (else 0).

    The models with the most photographs come first; of equal ones, the likeliest folder.
    """
    models = list[Path]()
    for place in MODEL_FOLDERS:
        folder = root / place
        below = sorted(path for path in folder.iterdir() if path.is_dir()) if place and folder.is_dir() else []
        found = [path for path in (*below, folder) if any(os.path.lexists(path / f"cameras{e}") for e in KINDS)]
        found = [path for path in found if path not in models]
        models += found
    counts = {model: _number_of_images(model) if len(models) > 1 else 0 for model in models}
    return dict(sorted(counts.items(), key=lambda model: model[1], reverse=True))


def _number_of_images(folder: Path) -> int:
    """Return how many photographs a model has; 0 if its list is missing or damaged, which reading it reports."""
    try:
        with reading(folder):
            return max(
                kind.number_of_images(path)
                for ending, kind in KINDS.items()
                if (path := folder / f"images{ending}").is_file()
            )
    except InputError:
        return 0


def read_model(folder: Path) -> ColmapModel:
    """Read a model, preferring binary files over text; refuse an incomplete one.

    Unreadable sparse points are left out, which is logged.
    """
    cameras_path, images_path, points_path = (_file_of(folder, name) for name in FILES)
    if cameras_path.suffix == ".bin" and (folder / "cameras.txt").is_file():
        log.info("%s holds a model in binary and in text: the binary one is read", folder)
    with reading(cameras_path, CURE):
        cameras = list(KINDS[cameras_path.suffix].cameras(cameras_path))
    twice = [number for number, count in Counter(camera.number for camera in cameras).items() if count > 1]
    if twice:
        raise InputError(f"{cameras_path} holds {listed(twice)} more than once. {CURE}")
    with reading(images_path, CURE):
        images = sorted(KINDS[images_path.suffix].images(images_path), key=lambda image: image.name)
    if not images:
        raise InputError(f"The model in {folder} has no registered photograph, so nothing can be learned. {CURE}")
    points = _points(points_path, folder / PLY)
    return ColmapModel({camera.number: camera for camera in cameras}, tuple(images), points)


def _file_of(folder: Path, name: str) -> Path:
    """Return the path of a model's file, binary or text; a missing file has the same kind as the others."""
    endings = [ending for ending in KINDS if (folder / f"{name}{ending}").is_file()]
    endings += [ending for ending in KINDS if any((folder / f"{other}{ending}").is_file() for other in FILES)]
    ending = next(iter(endings), ".txt")
    return folder / f"{name}{ending}"


def _points(path: Path, ply: Path) -> ColmapPoints:
    """Return the sparse points of a model, or of the PLY file that 3DGS writes; none if they cannot be read."""
    try:
        with reading(path, "They are not needed for training."):
            if os.path.lexists(path):
                return KINDS[path.suffix].points(path)
            if ply.is_file():
                return read_ply_points(ply)
    except InputError as error:
        log.warning("The sparse points are left out: %s", error)
    return NO_POINTS

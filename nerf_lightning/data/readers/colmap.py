"""COLMAP reconstructions: a model in `sparse/0` (or `sparse`), binary or text, beside a folder of photographs."""

import os
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from nerf_lightning.data.captures.capture import Capture, View, common_lens_model
from nerf_lightning.data.captures.reader import CaptureReader, picture_files
from nerf_lightning.data.pixels.decoding import Photograph
from nerf_lightning.data.readers.colmap_files import (
    CURE,
    BinaryFiles,
    ColmapCamera,
    ColmapImage,
    ColmapPoints,
    TextFiles,
)
from nerf_lightning.files.links import is_absolute, is_there
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.geometry.poses import rotation_from_quaternion
from nerf_lightning.nerf.types.scene import LensModel

# Which of its parameters are fx, fy, cx, cy, and which k1, k2, k3, k4, p1, p2; -1: none.
LAYOUTS: dict[str, tuple[LensModel, tuple[int, ...], tuple[int, ...]]] = {
    "SIMPLE_PINHOLE": ("pinhole", (0, 0, 1, 2), (-1, -1, -1, -1, -1, -1)),
    "PINHOLE": ("pinhole", (0, 1, 2, 3), (-1, -1, -1, -1, -1, -1)),
    "SIMPLE_RADIAL": ("radial_tangential", (0, 0, 1, 2), (3, -1, -1, -1, -1, -1)),
    "RADIAL": ("radial_tangential", (0, 0, 1, 2), (3, 4, -1, -1, -1, -1)),
    "OPENCV": ("radial_tangential", (0, 1, 2, 3), (4, 5, -1, -1, 6, 7)),
    "OPENCV_FISHEYE": ("fisheye", (0, 1, 2, 3), (4, 5, 6, 7, -1, -1)),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", (0, 0, 1, 2), (3, -1, -1, -1, -1, -1)),
    "RADIAL_FISHEYE": ("fisheye", (0, 0, 1, 2), (3, 4, -1, -1, -1, -1)),
}
FILES = ("cameras", "images", "points3D")
KINDS: dict[str, BinaryFiles | TextFiles] = {".bin": BinaryFiles(), ".txt": TextFiles()}
NO_POINTS = ColmapPoints(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2), np.int64))
TOLERANCE = 1e-4
"""Relative and absolute, to which a model and its twin in text agree: few digits may have been written."""


@dataclass(frozen=True)
class ColmapModel:
    """What the three files say."""

    cameras: dict[int, ColmapCamera]
    images: tuple[ColmapImage, ...]
    """In order of their names."""
    points: ColmapPoints


@dataclass
class ColmapReader(CaptureReader):
    """Read a COLMAP model, binary or text, with one camera for all photographs or one for each.

    Args:
        images: the folder of the photographs below root; a shrunk copy such as images_4 will do.
    """

    name: str = "colmap"
    images: str = "images"

    def capture(self) -> Capture:
        """Return the registered photographs, in order of their names."""
        root = self.folder()
        folder = find_model(root)
        for path in (folder / f"{name}{ending}" for name in FILES for ending in KINDS):
            if path.is_file():
                self.require_inside(path)
        model = read_model(folder)
        pictures = root / self.images
        if not os.path.isdir(pictures):
            raise InputError(
                f"{pictures} does not exist, and the model's photographs are looked for there. Set scene.images to "
                f"their folder below {root}."
            )
        self.require_inside(pictures, self.images)
        lost = [image.name for image in model.images if not is_there(pictures / image.name)]
        if lost:
            raise InputError(_absent(lost, pictures, folder, len(model.images)))
        lens_model = _lens_model({model.cameras[image.camera].model for image in model.images}, folder)
        registered = {image.name for image in model.images}
        return Capture(
            views=tuple(self._view(image, model.cameras[image.camera], pictures) for image in model.images),
            source=folder,
            lens_model=lens_model,
            points=torch.from_numpy(model.points.positions),
            point_errors=torch.from_numpy(model.points.errors),
            tracks=torch.from_numpy(_tracks(model)),
            left_out=tuple(name for name in picture_files(pictures) if name not in registered),
        )

    def _view(self, image: ColmapImage, camera: ColmapCamera, pictures: Path) -> View:
        _, pinhole, lens = LAYOUTS[camera.model]
        fx, fy, cx, cy = (camera.params[place] for place in pinhole)
        k1, k2, k3, k4, p1, p2 = (camera.params[place] if place >= 0 else 0.0 for place in lens)
        path = pictures / image.name
        self.require_inside(path, self.images)
        return View(
            name=image.name,
            photograph=Photograph(path, self.mask_of(image.name)),
            c2w=_c2w(image),
            focal=(fx, fy),
            center=(cx, cy),
            size=(float(camera.width), float(camera.height)),
            lens=(k1, k2, k3, k4, p1, p2),
        )


def _tracks(model: ColmapModel) -> Int[ndarray, "seen 2"]:
    """Return which point was seen in which photograph, by their rows; photographs that the model lacks are left out."""
    numbers = np.array([image.number for image in model.images])
    order = np.argsort(numbers)
    point, seen = model.points.tracks.T
    row = np.searchsorted(numbers[order], seen).clip(max=len(numbers) - 1)
    known = numbers[order][row] == seen
    return np.stack([point[known], order[row[known]]], axis=1)


def _absent(lost: list[str], pictures: Path, folder: Path, count: int) -> str:
    if any(is_absolute(name) for name in lost):
        return (
            f"The model in {folder} names photographs by absolute paths of another machine: {listed(lost, cap=3)}. "
            "Make the names relative to the folder of the photographs (reconstruct with that folder as COLMAP's "
            "image_path)."
        )
    return (
        f"{pictures} lacks {len(lost)} of the {count} photographs of the model in {folder}: {listed(lost)}. Copy them "
        "there, or set scene.images to the folder that has them."
    )


def _c2w(image: ColmapImage) -> Float[Tensor, "3 4"]:
    """Invert world-to-camera with axes right, down, forward into camera-to-world with axes right, up, back."""
    rotation = rotation_from_quaternion(torch.tensor(image.rotation, dtype=torch.float64))
    translation = torch.tensor(image.translation, dtype=torch.float64)
    center = -rotation.mT @ translation
    return torch.cat([rotation.mT * torch.tensor([1.0, -1.0, -1.0]), center[:, None]], dim=-1)


def _lens_model(used: set[str], folder: Path) -> LensModel:
    unknown = sorted(used - LAYOUTS.keys())
    if unknown:
        raise InputError(
            f"{folder} uses the camera model {listed(unknown)}, whose lens is not known here; known are "
            f"{listed(LAYOUTS)}. Undistort the photographs with `colmap image_undistorter`, or reconstruct with "
            "OPENCV (or OPENCV_FISHEYE)."
        )
    lens_model = common_lens_model({LAYOUTS[name][0] for name in used})
    if lens_model is None:
        raise InputError(
            f"{folder} mixes fisheye lenses with others ({listed(sorted(used))}), and a scene has one kind. Undistort "
            "the photographs with `colmap image_undistorter`, or split the capture."
        )
    return lens_model


def find_model(root: Path) -> Path:
    """Return the folder of the model in a capture, which must be `sparse/0`, `sparse`, or the folder itself."""
    for folder in (root / "sparse" / "0", root / "sparse", root):
        if any((folder / f"cameras{ending}").is_file() for ending in KINDS):
            return folder
    raise InputError(
        f"{root} holds no COLMAP model: there is no cameras.bin or cameras.txt in sparse/0, in sparse, or in the "
        "folder itself. Point scene.root at the folder above sparse/, or make a model with nerf poses images=DIR."
    )


def read_model(folder: Path) -> ColmapModel:
    """Read a model, binary or text; refuse one that is not whole, or two that disagree."""
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
    cameras = list(files.cameras(cameras_path))
    twice = [number for number, count in Counter(camera.number for camera in cameras).items() if count > 1]
    if twice:
        raise InputError(f"{cameras_path} holds {listed(twice)} more than once. {CURE}")
    images = sorted(files.images(images_path), key=lambda image: image.name)
    points = files.points(points_path) if points_path.exists() else NO_POINTS
    return ColmapModel({camera.number: camera for camera in cameras}, tuple(images), points)


def _agree(a: ColmapModel, b: ColmapModel) -> bool:
    if [image.name for image in a.images] != [image.name for image in b.images]:
        return False
    pairs = zip(_numbers_of(a), _numbers_of(b), strict=True)
    return all(len(x) == len(y) and np.allclose(x, y, rtol=TOLERANCE, atol=TOLERANCE) for x, y in pairs)


def _numbers_of(model: ColmapModel) -> Iterable[list[float]]:
    for image in model.images:
        camera = model.cameras.get(image.camera)
        intrinsics = (float(camera.width), float(camera.height), *camera.params) if camera else ()
        # A quaternion and its negative are one rotation, and have the same products.
        yield [*np.outer(image.rotation, image.rotation).ravel().tolist(), *image.translation, *intrinsics]

"""OpenSfM's `reconstruction.json`, also in projects of ODM (WebODM): cameras, and shots with their poses."""

import logging
import os
from pathlib import Path
from typing import Any

import torch

from nerf_lightning.data.captures.capture import Capture
from nerf_lightning.data.captures.find_pictures import pictures_below
from nerf_lightning.extensions.other_formats.posed import (
    Format,
    Intrinsics,
    Pose,
    Posed,
    PosedReader,
    Size,
    from_world_to_camera,
    number,
    numbers,
    panorama,
    sparse_points,
)
from nerf_lightning.files.json_files import mapping, read_json
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.geometry.poses import rotation_from_vector
from nerf_lightning.nerf.types.scene import LensModel

ODM = "opensfm/reconstruction.json"
PLACES = {
    "reconstruction.json": "images",
    ODM: "images",
    "undistorted/reconstruction.json": "undistorted/images",
    "opensfm/undistorted/reconstruction.json": "opensfm/undistorted/images",
}
"""Reconstructions, and the folder of photographs of each."""
LENSES: dict[str, tuple[LensModel, tuple[str, ...]]] = {
    "perspective": ("radial_tangential", ("k1", "k2")),
    "simple_radial": ("radial_tangential", ("k1",)),
    "radial": ("radial_tangential", ("k1", "k2")),
    "brown": ("radial_tangential", ("k1", "k2", "k3", "", "p1", "p2")),
    "fisheye": ("fisheye", ("k1", "k2")),
    "fisheye_opencv": ("fisheye", ("k1", "k2", "k3", "k4")),
}
"""By projection_type: the kind of lens, and the keys of k1, k2, k3, k4, p1, p2."""
PANORAMAS = ("spherical", "equirectangular")

log = logging.getLogger(__name__)


def _read(reader: PosedReader, path: Path) -> Capture:
    """Read the largest reconstruction. Its frame is local: east, north, up in meters if photographs have GPS.

    A shot's rotation is axis-angle, world to camera. Lengths in a picture are in units of its longer side.
    """
    root = reader.folder()
    folders = {root / place: root / pictures for place, pictures in PLACES.items() if (root / place).is_file()}
    if not os.path.isfile(Path(reader.root).expanduser()):  # the first whose photographs exist
        path = next((place for place, pictures in folders.items() if pictures_below(pictures)), path)
    pictures = folders.get(path, root)
    folder = pictures if pictures_below(pictures) else None
    if folder is None and all("undistorted" in picture.relative_to(root).parts for picture in pictures_below(root)):
        raise InputError(
            f"{root} of OpenSfM or ODM holds no photographs. Give the folder that holds images and "
            "reconstruction.json, or the ODM project, which holds images and opensfm."
        )
    found = _largest(path)
    cameras = mapping(found.get("cameras"))

    def posed(shot: tuple[str, Any], where: str) -> Posed:
        name, said = shot[0], mapping(shot[1])

        def camera(_: Size) -> tuple[Pose, Intrinsics]:
            key = said.get("camera")
            if not isinstance(key, str) or key not in cameras:
                raise InputError(f"{where} has the camera {key}, which is not among the cameras of {path}.")
            return _pose(said, where), _intrinsics(mapping(cameras[key]), f"{path}: cameras.{key}")

        return Posed(name, where, camera)

    shots = {f"shots.{name}": (name, shot) for name, shot in mapping(found.get("shots")).items()}
    points = [mapping(point).get("coordinates") for point in mapping(found.get("points")).values()]
    return reader.posed(path, shots, posed, folder, folder, points=sparse_points(points, path))


def _largest(path: Path) -> dict[str, Any]:
    """Return the reconstruction with most shots, and log that there are others."""
    content = read_json(path)
    parts = [part for part in content if isinstance(part, dict)] if isinstance(content, list) else []
    counts = [len(mapping(part.get("shots"))) for part in parts]
    if not any(counts):
        raise InputError(
            f"{path} of OpenSfM or ODM holds no reconstruction: no photograph has a pose. Run the reconstruction again."
        )
    if len(parts) > 1:
        log.warning(
            "%s: of %d reconstructions of %s photographs, which have frames of their own, the largest is read",
            *(path, len(parts), listed(counts, 5)),
        )
    return parts[counts.index(max(counts))]


def _pose(shot: dict[str, Any], where: str) -> Pose:
    axis = numbers(shot.get("rotation"), 3, f"{where}: rotation")
    shift = numbers(shot.get("translation"), 3, f"{where}: translation")
    rotation = rotation_from_vector(torch.tensor(axis, dtype=torch.float64))
    return from_world_to_camera(torch.cat([rotation, torch.tensor(shift, dtype=torch.float64)[:, None]], dim=1), where)


def _intrinsics(camera: dict[str, Any], where: str) -> Intrinsics:
    kind = camera.get("projection_type", "perspective")
    width, height = number(camera, "width", where), number(camera, "height", where)
    if kind in PANORAMAS:
        return panorama((width, height))
    if kind not in LENSES:
        raise InputError(
            f"{where} has the projection_type {kind}, which is not supported ({listed((*LENSES, *PANORAMAS), 9)} are). "
            "Undistort the photographs (opensfm undistort), and read the folder undistorted."
        )
    lens_model, keys = LENSES[kind]
    values = [number(camera, key, where, 0.0) if key else 0.0 for key in keys]
    k1, k2, k3, k4, p1, p2 = (*values, *[0.0] * (6 - len(values)))
    unit = max(width, height)
    x = number(camera, "focal_x", where, camera.get("focal"))
    y = number(camera, "focal_y", where, x)
    center = width / 2 + unit * number(camera, "c_x", where, 0.0), height / 2 + unit * number(camera, "c_y", where, 0.0)
    return Intrinsics((unit * x, unit * y), center, (width, height), lens_model, (k1, k2, k3, k4, p1, p2))


FORMAT = Format("OpenSfM or ODM", tuple((place, r"\A\s*\[") for place in PLACES), _read)

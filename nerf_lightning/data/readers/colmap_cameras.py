"""COLMAP's camera models (colmap.github.io/cameras.html): their IDs, parameters and lenses."""

import math
from dataclasses import dataclass
from pathlib import Path

from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.types.scene import LensModel


@dataclass(frozen=True)
class CameraModel:
    """Layout of a model's parameters; -1 marks a parameter that it does not have."""

    number: int
    """Its ID in binary files."""
    num_params: int
    lens: LensModel | None = None
    """None: not supported."""
    pinhole: tuple[int, ...] = ()
    """Indices of fx, fy, cx, cy."""
    terms: tuple[int, int, int, int, int, int] = (-1, -1, -1, -1, -1, -1)
    """Indices of k1, k2, k3, k4, p1, p2."""
    zeros: tuple[int, ...] = ()
    """Indices of unsupported rational, tangential and thin-prism terms: they must be 0."""


ONE, TWO = (0, 0, 1, 2), (0, 1, 2, 3)
"""Parameters of a model with one focal length, and with two."""
CAMERA_MODELS = {
    "SIMPLE_PINHOLE": CameraModel(0, 3, "pinhole", ONE),
    "PINHOLE": CameraModel(1, 4, "pinhole", TWO),
    "SIMPLE_RADIAL": CameraModel(2, 4, "radial_tangential", ONE, (3, -1, -1, -1, -1, -1)),
    "RADIAL": CameraModel(3, 5, "radial_tangential", ONE, (3, 4, -1, -1, -1, -1)),
    "OPENCV": CameraModel(4, 8, "radial_tangential", TWO, (4, 5, -1, -1, 6, 7)),
    "OPENCV_FISHEYE": CameraModel(5, 8, "fisheye", TWO, (4, 5, 6, 7, -1, -1)),
    "FULL_OPENCV": CameraModel(6, 12, "radial_tangential", TWO, (4, 5, 8, -1, 6, 7), (9, 10, 11)),
    "FOV": CameraModel(7, 5),
    "SIMPLE_RADIAL_FISHEYE": CameraModel(8, 4, "fisheye", ONE, (3, -1, -1, -1, -1, -1)),
    "RADIAL_FISHEYE": CameraModel(9, 5, "fisheye", ONE, (3, 4, -1, -1, -1, -1)),
    "THIN_PRISM_FISHEYE": CameraModel(10, 12, "fisheye", TWO, (4, 5, 8, 9, -1, -1), (6, 7, 10, 11)),
    "RAD_TAN_THIN_PRISM_FISHEYE": CameraModel(11, 16),
    "SIMPLE_DIVISION": CameraModel(12, 4),
    "DIVISION": CameraModel(13, 5),
    "SIMPLE_FISHEYE": CameraModel(14, 3, "fisheye", ONE),
    "FISHEYE": CameraModel(15, 4, "fisheye", TWO),
    "EUCM": CameraModel(16, 6),
    "EQUIRECTANGULAR": CameraModel(17, 2, "equirectangular", (0, 1, 0, 1)),
}
BY_NUMBER = {model.number: name for name, model in CAMERA_MODELS.items()}


@dataclass(frozen=True)
class ColmapCamera:
    """One camera's intrinsics."""

    number: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]


def intrinsics_of(
    camera: ColmapCamera,
) -> tuple[tuple[float, float], tuple[float, float], tuple[float, float, float, float, float, float]]:
    """Return focal lengths and principal point in pixels, and k1, k2, k3, k4, p1, p2.

    For a panorama, the focal lengths are in pixels per radian.
    """
    model = CAMERA_MODELS[camera.model]
    fx, fy, cx, cy = (camera.params[place] for place in model.pinhole)
    k1, k2, k3, k4, p1, p2 = (camera.params[place] if place >= 0 else 0.0 for place in model.terms)
    if camera.model == "EQUIRECTANGULAR":  # its parameters are its size
        fx, fy, cx, cy = fx / (2 * math.pi), fy / math.pi, fx / 2, fy / 2
    return (fx, fy), (cx, cy), (k1, k2, k3, k4, p1, p2)


def lens_of(camera: ColmapCamera, folder: Path) -> LensModel:
    """Return a camera's lens model.

    Refuse a camera that none of ours can express, or only without some of its terms.

    Raises:
        InputError: the model is not supported; the message lists those that are.
    """
    model = CAMERA_MODELS[camera.model]
    if model.lens is not None and not any(camera.params[place] for place in model.zeros):
        return model.lens
    terms = " with terms that ours do not have" if model.lens else ""
    supported = [name for name, each in CAMERA_MODELS.items() if each.lens]
    raise InputError(
        f"{folder} uses the camera model {camera.model}{terms}, whose lens is not supported; supported "
        f"are {listed(supported, len(supported))}. Undistort the photographs with `colmap image_undistorter`, or "
        "reconstruct with OPENCV (or OPENCV_FISHEYE)."
    )

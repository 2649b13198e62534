"""Intrinsics as nerfstudio and instant-ngp write them; `settings` are a frame's, over those at the file's top."""

import math
from typing import Any

from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.geometry.cameras import focal_from_fov
from nerf_lightning.nerf.types.scene import LensModel

LENSES: dict[str, LensModel] = {
    "PINHOLE": "pinhole",
    "SIMPLE_PINHOLE": "pinhole",
    "SIMPLE_RADIAL": "radial_tangential",
    "RADIAL": "radial_tangential",
    "OPENCV": "radial_tangential",
    "OPENCV_FISHEYE": "fisheye",
    "EQUIRECTANGULAR": "equirectangular",
}
COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")


def number_of(settings: dict[str, Any], key: str, where: str, default: float | None = None) -> float:
    """Return a number.

    Raises:
        InputError: it is missing without a default, or no number.
    """
    value = settings.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}: {key} is {value!r}, but it must be a number. Export the file again.")
    try:
        return float(value)
    except OverflowError:
        raise InputError(f"{where}: {key} has too many digits for a number of a camera. Mend it.") from None


def size_of(settings: dict[str, Any], where: str) -> tuple[float, float] | None:
    """Return (width, height) for which the intrinsics hold; None where the file leaves it to the picture.

    Raises:
        InputError: one of them is missing, or no number.
    """
    if "w" not in settings and "h" not in settings:
        return None
    return number_of(settings, "w", where), number_of(settings, "h", where)


def focal_of(settings: dict[str, Any], width: float, height: float, where: str) -> tuple[float, float]:
    """Return the focal lengths in pixels; one that is missing is the other one.

    Raises:
        InputError: both are missing, or one is no number.
    """

    def along(side: str, length: float) -> float | None:
        if f"fl_{side}" in settings:
            return number_of(settings, f"fl_{side}", where)
        if f"camera_angle_{side}" not in settings:
            return None
        angle = number_of(settings, f"camera_angle_{side}", where)
        if not 0.0 < angle < math.pi:
            raise InputError(f"{where}: camera_angle_{side} is {angle}, but it must lie between 0 and pi radians.")
        return focal_from_fov(length, angle)

    x, y = along("x", width), along("y", height)
    if x is not None:
        return x, (x if y is None else y)
    if y is not None:
        return y, y
    raise InputError(
        f"{where} has no focal length: neither fl_x (pixels) nor camera_angle_x (radians) stands in it or at the "
        "file's top. If the file comes from another tool, export it in nerfstudio's or instant-ngp's format."
    )


def panorama_focal_of(settings: dict[str, Any], width: float, height: float, where: str) -> tuple[float, float]:
    """Return pixels per radian of an equirectangular panorama.

    nerfstudio's fl_x and fl_y count pixels per half turn: half the width and the height of a whole panorama, which
    they are taken for where they are missing.

    Raises:
        InputError: one is no number, or shows some directions twice.
    """
    x, y = number_of(settings, "fl_x", where, width / 2), number_of(settings, "fl_y", where, height)
    if not (x >= 0.495 * width and y >= 0.99 * height):
        raise InputError(
            f"{where} is a panorama (EQUIRECTANGULAR) with fl_x={x:g} and fl_y={y:g} for {width:g} x {height:g} "
            "pixels, which would show some directions twice. For a whole panorama these are half the width and the "
            "height: remove both, or export it again."
        )
    return max(x, width / 2) / math.pi, max(y, height) / math.pi


def lens_of(settings: dict[str, Any], where: str) -> tuple[LensModel, tuple[float, float, float, float, float, float]]:
    """Return the kind of lens, and k1, k2, k3, k4, p1, p2.

    Raises:
        InputError: a kind that is not known, or a pinhole with distortion.
    """
    k1, k2, k3, k4, p1, p2 = (number_of(settings, key, where, 0.0) for key in COEFFICIENTS)
    lens = (k1, k2, k3, k4, p1, p2)
    bent = any(lens)
    model = settings.get("camera_model", "OPENCV_FISHEYE" if settings.get("is_fisheye") else "OPENCV")
    if not isinstance(model, str) or model not in LENSES:
        raise InputError(
            f"{where} has the camera_model {model!r}; known are {listed(LENSES)}. Undistort the photographs first, or "
            "export them as perspective pictures."
        )
    kind = LENSES[model]
    if kind in ("pinhole", "equirectangular") and bent:
        raise InputError(
            f"{where} has the camera_model {model} and distortion coefficients. Remove the one or the other."
        )
    return ("pinhole" if kind == "radial_tangential" and not bent else kind), lens

"""The frames of json files, in the flavours of Blender, nerfstudio and instant-ngp: paths, poses and intrinsics.

`settings` are a frame's keys over those at the file's top. What is read here is numbers; whether they make a camera is
judged by `captures.checks`.
"""

import math
from pathlib import Path
from typing import Any

from nerf_lightning.files.budgets import require_within
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed, require_printable
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


def list_of_frames(frames: object, path: Path) -> list[Any]:
    """Return the frames of a file; refuse no list, and more than a person has agreed to."""
    if not isinstance(frames, list):
        raise InputError(f"{path}: frames must be a list of views, but it is {type(frames).__name__}.")
    require_within("views", len(frames), str(path), "views")
    return frames


def path_of(name: object, key: str, where: str) -> str:
    """Return a path as the file has it; refuse what is no text, or cannot be shown."""
    if not isinstance(name, str) or not name:
        raise InputError(f"{where}: {key} is {name!r}, but it must be the picture's path as text.")
    require_printable(name, where)
    return name


def number_of(settings: dict[str, Any], key: str, where: str, default: float | None = None) -> float:
    """Return a number; refuse anything else, and one that is missing without a default."""
    value = settings.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}: {key} is {value!r}, but it must be a number. Export the file again.")
    try:
        return float(value)
    except OverflowError:
        raise InputError(f"{where}: {key} has too many digits for a number of a camera. Mend it.") from None


def positive_of(settings: dict[str, Any], key: str, where: str, default: float | None = None) -> float:
    """Return a number above 0; `InputError` refuses another, and infinity."""
    value = number_of(settings, key, where, default)
    if not 0 < value < math.inf:
        raise InputError(f"{where}: {key} is {value:g}, but it must be above 0. Mend it, or remove it.")
    return value


def focal_of_angle(settings: dict[str, Any], side: str, length: float, where: str) -> float:
    """Return the focal length in pixels of a field of view of `camera_angle_x` or `_y` radians, between 0 and pi."""
    angle = number_of(settings, f"camera_angle_{side}", where)
    if not 0.0 < angle < math.pi:
        raise InputError(f"{where}: camera_angle_{side} is {angle}, but it must lie between 0 and pi radians.")
    return focal_from_fov(length, angle)


def focal_of(settings: dict[str, Any], width: float, height: float, where: str) -> tuple[float, float]:
    """Return the focal lengths in pixels, of which one must be there; one that is missing is the other one."""
    found = []
    for side, length in (("x", width), ("y", height)):
        if f"fl_{side}" in settings:
            found.append(number_of(settings, f"fl_{side}", where))
        elif f"camera_angle_{side}" in settings:
            found.append(focal_of_angle(settings, side, length, where))
    if not found:
        raise InputError(
            f"{where} has no focal length: neither fl_x (pixels) nor camera_angle_x (radians) stands in it or at the "
            "file's top. If the file comes from another tool, export it in nerfstudio's or instant-ngp's format."
        )
    return found[0], found[-1]


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
    """Return the kind of lens, and k1, k2, k3, k4, p1, p2; refuse unknown kinds, and pinholes with distortion."""
    k1, k2, k3, k4, p1, p2 = (number_of(settings, key, where, 0.0) for key in COEFFICIENTS)
    lens = (k1, k2, k3, k4, p1, p2)
    model = settings.get("camera_model", "OPENCV_FISHEYE" if settings.get("is_fisheye") else "OPENCV")
    kind = LENSES.get(model) if isinstance(model, str) else None
    if kind is None:
        raise InputError(
            f"{where} has the camera_model {model!r}; known are {listed(LENSES)}. Undistort the photographs first, or "
            "export them as perspective pictures."
        )
    if kind in ("pinhole", "equirectangular") and any(lens):
        raise InputError(
            f"{where} has the camera_model {model} and distortion coefficients. Remove the one or the other."
        )
    return ("pinhole" if kind == "radial_tangential" and not any(lens) else kind), lens

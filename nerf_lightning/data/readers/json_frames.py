"""The frames of JSON files, in the flavors of Blender, nerfstudio and instant-ngp: pictures, poses and intrinsics.

`settings` are a frame's keys merged over the file's top-level keys; a key that is null counts as missing. This only
reads numbers; `captures.checks` decides whether they are valid cameras.
"""

import logging
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from nerf_lightning.data.captures.capture import View
from nerf_lightning.data.captures.checks import pose_from_matrix
from nerf_lightning.data.captures.find_pictures import find_pictures, why_absent
from nerf_lightning.data.captures.left_out import LeftOut
from nerf_lightning.data.pixels.decoded_photographs import Photograph
from nerf_lightning.data.pixels.picture_files import read_header, read_rgba
from nerf_lightning.data.pixels.plain_background import TOLERANCE
from nerf_lightning.data.readers.unknown_keys import say_of_keys
from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.json_files import keys_of, read_json
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed, require_printable
from nerf_lightning.nerf.geometry.cameras import focal_from_fov
from nerf_lightning.nerf.geometry.world_frame import LARGEST_UNIT, LEAST_UNIT
from nerf_lightning.nerf.types.scene import LensModel

LENSES: dict[str, LensModel] = {
    "PINHOLE": "pinhole",
    "SIMPLE_PINHOLE": "pinhole",
    "PERSPECTIVE": "radial_tangential",
    "SIMPLE_RADIAL": "radial_tangential",
    "RADIAL": "radial_tangential",
    "OPENCV": "radial_tangential",
    "FULL_OPENCV": "radial_tangential",
    "OPENCV_FISHEYE": "fisheye",
    "FISHEYE": "fisheye",
    "SIMPLE_FISHEYE": "fisheye",
    "SIMPLE_RADIAL_FISHEYE": "fisheye",
    "RADIAL_FISHEYE": "fisheye",
    "EQUIRECTANGULAR": "equirectangular",
}
COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
UNREAD_LENSES = ("ftheta_p0", "latlong", "equirectangular")
"""Keys of instant-ngp's unsupported lenses."""
ANGLES = {"camera_angle_": (math.pi, "pi radians"), "_fov": (180.0, "180 degrees")}
"""Upper bound of a field of view, by its key."""
TRANSPARENT = {"white_transparent": 255, "black_transparent": 0}
"""Keys of instant-ngp that mark pixels of that level as transparent."""
OF_PHOTOGRAPHS = ("fl_x", "fl_y", "k1", "k2", "p1", "p2", "camera_model", "aabb_scale")
"""Keys that renderings of the Blender format do not have."""
FORMAT = "A transforms.json of nerfstudio or instant-ngp"

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FrameFile:
    """A JSON file with frames."""

    path: Path
    content: dict[str, Any]
    frames: list[Any]

    @classmethod
    def read(cls, path: Path, wanted_by: str = FORMAT) -> "FrameFile":
        """Return the content of a file; raise `InputError` for one without a list of frames."""
        content = read_json(path)
        (frames,) = keys_of(content, ("frames",), str(path), wanted_by)
        if not isinstance(frames, list):
            raise InputError(f"{path}: frames must be a list of views, but it is {type(frames).__name__}.")
        require_within("views", len(frames), path, "views")
        if content.get("from_mitsuba"):
            raise InputError(
                f"{path} says from_mitsuba, and Mitsuba's cameras use other axes than those of Blender and nerfstudio. "
                "Negate the first and third columns of each transform_matrix, and remove it."
            )
        return cls(path, {key: value for key, value in content.items() if value is not None}, frames)

    @property
    def is_photographed(self) -> bool:
        """Return whether these are photographs, such as instant-ngp's, instead of renderings of the Blender format.

        Photographs have a lens, or opaque pictures whose four corners are not all of one color.
        """
        first = self.frames[0] if self.frames and isinstance(self.frames[0], dict) else {}
        if any(key in {**self.content, **first} for key in OF_PHOTOGRAPHS):
            return True
        name, folder = first.get("file_path"), self.path.parent
        pictures = find_pictures([name], folder, folder, self.path, photographs=()) if isinstance(name, str) else {}
        if not pictures:
            return False
        try:
            picture = read_rgba(pictures[str(name)])
        except InputError:
            return False
        corners = picture[:: picture.shape[0] - 1 or 1, :: picture.shape[1] - 1 or 1].reshape(-1, 4).astype(int)
        return bool((picture[..., 3] == 255).all() and np.ptp(corners, axis=0).max() > 2 * TOLERANCE)


def say_of_files(files: Sequence[FrameFile]) -> None:
    """Log what in the files of one capture is not used or not modeled."""
    first, read = files[0].path, {file.path for file in files}
    beside = sorted(path.name for path in first.parent.glob("transform*_*.json") if path not in read)
    if beside:
        log.warning(
            "Frames are read from %s, and not from %s (scene=transforms scene.file=NAME reads another file)",
            *(listed((file.path for file in files), 3), listed(beside)),
        )
    for file in files:
        say_of_keys(file.path, (file.content, *(frame for frame in file.frames if isinstance(frame, dict))))
    times = {
        repr(frame["time"]) for file in files for frame in file.frames if isinstance(frame, dict) and "time" in frame
    }
    if len(times) > 1:
        log.warning(
            "%s: time differs between frames, but the scene is treated as static: moving content is blurred", first
        )


@dataclass(frozen=True)
class FoundFrame:
    """A frame whose picture exists."""

    name: str
    """Of the picture, as in the file."""
    settings: dict[str, Any]
    view: View
    lens_model: LensModel


def views_of(file: FrameFile, root: Path, outside: bool, left_out: LeftOut, every: int = 1) -> list[FoundFrame]:
    """Return the views of a file without those that cannot be used.

    Args:
        file: lists them.
        root: the capture's folder.
        outside: whether names may point outside it.
        left_out: collects the others.
        every: take every `every`-th frame.
    """
    named: list[tuple[str, str, Any]] = []
    for index, frame in list(enumerate(file.frames))[::every]:
        where = f"{file.path}: frames[{index}]"
        with left_out.unless_usable(f"frames[{index}]"):
            name, _ = keys_of(frame, ("file_path", "transform_matrix"), where, FORMAT)
            named.append((where, path_of(name, "file_path", where), frame))
    pictures = find_pictures([name for _, name, _ in named], file.path.parent, root, file.path, outside)
    found = []
    for where, name, frame in named:
        with left_out.unless_usable(PurePosixPath(name.replace("\\", "/")).as_posix()):
            if name not in pictures:
                raise InputError(f"{where}: {why_absent(name, file.path.parent, root)}")
            found.append(_found_frame(file, f"{where} ({name})", name, frame, pictures[name]))
    return found


def _found_frame(file: FrameFile, where: str, name: str, frame: dict[str, Any], picture: Path) -> FoundFrame:
    settings = file.content | {key: value for key, value in frame.items() if value is not None}
    lens_model, lens = lens_of(settings, where)
    header = read_header(picture)
    stored_width, stored_height = map(float, header.size)
    # The intrinsics may be for another size.
    width, height = number_of(settings, "w", where, stored_width), number_of(settings, "h", where, stored_height)
    focal = panorama_focal_of if lens_model == "equirectangular" else focal_of
    folder, dynamic = file.path.parent, picture.with_name(f"dynamic_mask_{picture.name}").with_suffix(".png")
    view = View(
        name=picture.relative_to(folder if picture.is_relative_to(folder) else picture.anchor).as_posix(),
        photograph=Photograph(
            picture,
            mask=dynamic if os.path.isfile(dynamic) else None,
            mask_keeps="black" if os.path.isfile(dynamic) else None,
            radius=_radius(settings, stored_width, width, where),
            transparent=next((level for key, level in TRANSPARENT.items() if settings.get(key) is True), None),
            header=header,
        ),
        c2w=pose_from_matrix(frame["transform_matrix"], f"{where}: transform_matrix"),
        focal=focal(settings, width, height, where),
        center=(number_of(settings, "cx", where, width / 2), number_of(settings, "cy", where, height / 2)),
        size=(width, height),
        lens=lens,
    )
    return FoundFrame(name, settings, view, lens_model)


def _radius(settings: dict[str, Any], stored_width: float, width: float, where: str) -> float | None:
    """Return the radius of a fisheye's valid circle (nerfstudio), in pixels of the actual picture."""
    if not settings.get("fisheye_crop_radius"):
        return None
    radius = positive_of(settings, "fisheye_crop_radius", where)
    return radius * stored_width / width if width > 0 else None


def path_of(name: object, key: str, where: str) -> str:
    """Return a path as in the file; refuse values that are not text or not printable."""
    if not isinstance(name, str) or not name:
        raise InputError(f"{where}: {key} is {name!r}, but it must be a path as text.")
    require_printable(name, where)
    return name


def number_of(settings: dict[str, Any], key: str, where: str, default: float | None = None) -> float:
    """Return a number; refuse anything else, and a missing one without a default."""
    value = settings.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}: {key} is {value!r}, but it must be a number. Export the file again.")
    try:
        return float(value)
    except OverflowError:
        raise InputError(f"{where}: {key} has too many digits. Fix it.") from None


def positive_of(settings: dict[str, Any], key: str, where: str, default: float | None = None) -> float:
    """Return a finite number above 0; raise `InputError` for any other."""
    value = number_of(settings, key, where, default)
    if not 0 < value < math.inf:
        raise InputError(f"{where}: {key} is {value:g}, but it must be above 0. Fix it, or remove it.")
    return value


def length_of(settings: dict[str, Any], key: str, where: str, default: float | None = None) -> float:
    """Return a factor of lengths; raise `InputError` if it cannot be the scale of a capture."""
    value = positive_of(settings, key, where, default)
    if not LEAST_UNIT <= value <= LARGEST_UNIT:
        raise InputError(f"{where}: {key} is {value:g}, which is no scale. Fix it, or remove it.")
    return value


def focal_of_angle(settings: dict[str, Any], key: str, length: float, where: str) -> float:
    """Return the focal length in pixels for the field of view under a key: in radians, or degrees for `x_fov`."""
    angle, (half_turn, unit) = number_of(settings, key, where), ANGLES[key.strip("xy")]
    if not 0.0 < angle < half_turn:
        raise InputError(f"{where}: {key} is {angle}, but it must lie between 0 and {unit}.")
    return focal_from_fov(length, angle * math.pi / half_turn)


def focal_of(settings: dict[str, Any], width: float, height: float, where: str) -> tuple[float, float]:
    """Return the focal lengths in pixels, at least one of which is required; a missing one equals the other."""
    found = []
    for side, length in (("x", width), ("y", height)):
        if f"fl_{side}" in settings:
            found.append(number_of(settings, f"fl_{side}", where))
        elif key := next((key for key in (f"{side}_fov", f"camera_angle_{side}") if key in settings), None):
            found.append(focal_of_angle(settings, key, length, where))
    if not found:
        raise InputError(
            f"{where} has no focal length: neither fl_x (pixels) nor camera_angle_x (radians) nor x_fov (degrees) is "
            "given in it or at the top of the file. If the file comes from another tool, export it in nerfstudio's or "
            "instant-ngp's format."
        )
    return found[0], found[-1]


def panorama_focal_of(settings: dict[str, Any], width: float, height: float, where: str) -> tuple[float, float]:
    """Return pixels per radian of an equirectangular panorama.

    nerfstudio's fl_x and fl_y count pixels per half turn: half the width and the height of a whole panorama, which are
    also their defaults.

    Raises:
        InputError: one is not a number, or shows some directions twice.
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
    other = next((key for key in UNREAD_LENSES if settings.get(key)), None)
    if other is not None:
        raise InputError(f"{where} has {other}, a lens of instant-ngp that is not supported. Use perspective pictures.")
    model = model.strip().upper() if isinstance(model, str) else model
    kind = LENSES.get(model) if isinstance(model, str) else None
    if kind is None:
        raise InputError(
            f"{where} has the camera_model {model!r}; supported are {listed(LENSES, len(LENSES))}. Undistort the "
            "photographs first, or export them as perspective pictures."
        )
    if kind in ("pinhole", "equirectangular") and any(lens):
        raise InputError(f"{where} has the camera_model {model} and distortion coefficients. Remove one of them.")
    # The radial distortion is divided by 1 + k4 r^2 + k5 r^4 + k6 r^6; without k5 and k6, k4 is nerfstudio's r^8.
    divided = ("k4", "k5", "k6") if model == "FULL_OPENCV" else ("k5", "k6")
    if kind == "radial_tangential" and any(number_of(settings, key, where, 0.0) for key in divided):
        raise InputError(
            f"{where} has the camera_model {model} with {listed(divided)}, which divide the distortion (a rational "
            "lens) and are not supported. Calibrate with OPENCV (k1, k2, p1, p2), or undistort the photographs."
        )
    return ("pinhole" if kind == "radial_tangential" and not any(lens) else kind), lens

"""Checks that readers share; each failure is one paragraph with the place and the cure."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import get_args

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.files.links import is_there
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.geometry.frames import LARGEST_UNIT, LEAST_UNIT
from nerf_lightning.nerf.geometry.poses import is_rigid
from nerf_lightning.nerf.types.scene import Background

LEAST_FOCAL, FARTHEST = 1e-3, 1e9
"""What a camera can have: a focal length in pixels, and coordinates (in the capture's units, and in the scene's) that
have not lost every digit that a picture could show."""
WIDEST = 170.0
"""Degrees across a picture, beyond which nothing was photographed through a perspective lens."""


def require_different(names: Iterable[str], where: str) -> None:
    """Refuse views that bear one name: files and tables are written by it.

    Raises:
        InputError: with the names, and where they stand.
    """
    twice = sorted(name for name, count in Counter(names).items() if count > 1)
    if twice:
        raise InputError(f"{where} lists {listed(twice)} more than once. Remove all but one of each.")


def impossible_lens(size: tuple[int | float, int | float], focal: tuple[int | float, int | float]) -> str | None:
    """Say why no perspective lens takes a picture of this size (width, height) at these focal lengths; None: some does.

    >>> impossible_lens((800, 600), (400, 400))
    >>> impossible_lens((800, 600), (0.5, 0.5))
    'a focal length of 0.5 pixels for 800 x 600 is a field of view of 179.9 degrees, which no perspective lens has'
    """
    across = max(math.degrees(2 * math.atan2(side, 2 * length)) for side, length in zip(size, focal, strict=True))
    if across <= WIDEST:
        return None
    return (
        f"a focal length of {min(focal):g} pixels for {size[0]:g} x {size[1]:g} is a field of view of {across:.1f} "
        "degrees, which no perspective lens has"
    )


def contents(folder: Path) -> str:
    """Return what a folder holds, in a few words."""
    try:
        return listed(sorted(path.name for path in folder.iterdir())) or "nothing"
    except OSError as error:  # it is not there either
        return f"nothing that can be read ({error.strerror})"


def check_step(name: str, value: object) -> None:
    """Refuse a factor or stride below 1.

    Raises:
        InputError: `value` is no whole number of at least 1; `name` is the setting's in the scene's configuration.
    """
    if type(value) is not int or value < 1:
        raise InputError(f"scene.{name} is {value}, but it must be 1 (take everything as it is) or more.")


def check_metres(metres_per_unit: float | None) -> None:
    """Refuse a unit of no length, or beyond all digits.

    Raises:
        InputError: it is one.
    """
    if metres_per_unit is not None and not LEAST_UNIT <= metres_per_unit <= LARGEST_UNIT:
        raise InputError(
            f"scene.metres_per_unit={metres_per_unit}: give how many metres one unit of the capture is long, such as "
            "0.01 for centimetres, or null where that is unknown."
        )


def check_bounds(near: float, far: float) -> None:
    """Refuse distances (scene units) that do not satisfy 0 <= near < far, or that are beyond all digits.

    Raises:
        InputError: they do not.
    """
    if not 0.0 <= near < far <= FARTHEST:
        raise InputError(
            f"scene.near is {near} and scene.far is {far}, but rays need 0 <= near < far <= {FARTHEST:g}. Set "
            "them to the distances from the cameras at which the content begins and ends, for example "
            "scene.near=2.0 scene.far=6.0."
        )


def box_around_origin(half: int | float) -> Float[Tensor, "2 3"]:
    """Return lower and upper corner of the cube whose sides lie `scene.aabb_half` (scene units) from the origin.

    Raises:
        InputError: it has no inside, or reaches beyond all digits.
    """
    if not 0 < half <= FARTHEST:
        raise InputError(
            f"scene.aabb_half is {half}, but half the side of a box must be above 0, and {FARTHEST:g} at most."
        )
    return torch.tensor([[-half] * 3, [half] * 3], dtype=torch.float32)


def known_background(name: str) -> Background:
    """Return `name` as a background.

    Raises:
        InputError: there is no such background.
    """
    for known in get_args(Background):
        if name == known:
            return known
    raise InputError(f"scene.background is {name!r}; choose one of {', '.join(get_args(Background))}.")


def pose_from_matrix(matrix: object, where: str) -> Float[Tensor, "3 4"]:
    """Return a camera-to-world pose (float64) from a nested list or array of 4 x 4 numbers.

    Args:
        matrix: what the file holds.
        where: the file and frame, for the message.

    Raises:
        InputError: not 4 x 4 numbers, not finite, or not a rotation with a centre over a last row 0 0 0 1.
    """
    try:
        pose = torch.as_tensor(matrix, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise InputError(f"{where} is not a 4 x 4 matrix of numbers. Export the camera poses again.") from None
    if pose.shape != (4, 4):
        shape = " x ".join(str(size) for size in pose.shape) or "a single number"
        raise InputError(f"{where} must be a 4 x 4 matrix, but it is {shape}. Export the camera poses again.")
    if not torch.isfinite(pose).all():
        raise InputError(f"{where} holds NaN or infinite numbers. Remove that frame or export the poses again.")
    if float(pose[:3, 3].abs().max()) > FARTHEST:
        raise InputError(
            f"{where} lies beyond {FARTHEST:g}, where no digit is left that a picture could show. Export the cameras "
            "again, in units of about the scene's size."
        )
    last = pose.new_tensor([0.0, 0.0, 0.0, 1.0])
    if not is_rigid(pose[:3]) or (pose[3] - last).abs().max() > 1e-3:
        raise InputError(
            f"{where} is not a camera pose: it must be a rotation (no scale, no mirror) and a centre over "
            "the row 0 0 0 1, camera to world with axes right, up, back. Apply the camera's scale before "
            "exporting, and make sure that the matrix is not transposed."
        )
    return pose[:3]


def one_size(sizes: Mapping[Path, tuple[int, int]]) -> tuple[int, int]:
    """Return the (width, height) that all images share.

    Raises:
        InputError: some images differ from the most frequent size; they are named.
    """
    usual = Counter(sizes.values()).most_common(1)[0][0]
    odd = [f"{path} ({size[0]} x {size[1]})" for path, size in sizes.items() if size != usual]
    if odd:
        raise InputError(
            f"The images of this format must all have one size. Most are {usual[0]} x {usual[1]}, but not "
            f"{listed(odd)}. Render or resize these again, or remove their frames."
        )
    return usual


def check_divisible(width: int, height: int, downscale: int) -> None:
    """Refuse a downscale that does not divide the image's size: the camera model knows no partial pixels.

    Raises:
        InputError: with the factors that work.
    """
    common = math.gcd(width, height)
    if common % downscale:
        factors = [factor for factor in range(1, common + 1) if common % factor == 0]
        raise InputError(
            f"scene.downscale={downscale} does not divide the images' size of {width} x {height} pixels. "
            f"Choose one of {listed(factors, cap=40)}."
        )


def check_present(files: Iterable[Path], named_in: Path) -> None:
    """Refuse absent files, all at once.

    Raises:
        InputError: the absent files, capped at ten, and the file that names them.
    """
    absent = [path for path in files if not is_there(path)]
    if absent:
        raise InputError(
            f"{named_in} names {len(absent)} image(s) that do not exist: {listed(absent)}. Copy them there, "
            "or remove their frames from the file."
        )

"""Validate the numbers of a capture, whatever its format, and the settings of scenes."""

import logging
import math
from dataclasses import replace
from functools import cache
from typing import get_args

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.data.captures.capture import Capture, View
from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.trust import Mismatch
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import for_terminal, listed, require_printable
from nerf_lightning.nerf.geometry.lens_checks import lens_faults
from nerf_lightning.nerf.geometry.poses import is_rigid
from nerf_lightning.nerf.geometry.world_frame import LARGEST_UNIT, LEAST_UNIT, unit_of
from nerf_lightning.nerf.types.scene import Background, Cameras, LensModel, SceneRecord

LEAST_FOCAL, FARTHEST = 1e-3, 1e9
"""Limits of a camera: its minimum focal length in pixels, and its largest coordinates (in the capture's units, and in
the scene's) that have not lost every digit that a picture could show."""
LEAST_SCALE, ALMOST_ONE = 1e-6, 4e-4
"""Of a rotation's scale: below the first it is invalid, and within the second of 1 it is rounding."""
ROUNDED = 1e-4
"""Of rotations, and of the cameras' distance from their center: poses that differ less are the same."""
SMALL = 16
"""Side in pixels, up to which a principal point may be as near to the corner as 1."""
WIDEST = 170.0
"""Maximum field of view of a perspective lens in degrees."""

log = logging.getLogger(__name__)


def usable(capture: Capture) -> Capture:
    """Return the capture without the views, points and depths that cannot be used.

    The scale of uniformly scaled rotations is removed; of two views of one picture the first one counts, if they agree.

    Raises:
        InputError: too few views remain.
    """
    require_within("views", len(capture.views), capture.source, "views")
    if not capture.views and not capture.left_out.faults:
        raise InputError(f"{capture.source} lists no views, so there is nothing to learn from. Export it again.")
    views, scales = zip(*map(_without_scale, capture.views), strict=True) if capture.views else ((), ())
    scaled = [scale for scale in scales if scale is not None]
    if scaled:
        log.warning(
            "%s: the rotations of %d of %d poses are scaled (by %.4g, the first); the scale is removed, and the centers"
            " stay",
            *(capture.source, len(scaled), len(views), scaled[0]),
        )
    centers = torch.stack([view.c2w[:, 3] for view in views]) if views else torch.zeros(1, 3)
    reach = float((centers - centers.nanmedian(dim=0).values).norm(dim=-1).nanmedian())
    first: dict[str, int] = {}
    same: dict[int, int] = {}
    kept = []
    for number, view in enumerate(views):
        with capture.left_out.unless_usable(view.name):
            # Names that are left out are only shown.
            require_printable(view.name, f"A photograph of {capture.source}")
            if fault := _fault_of(view, capture.lens_model):
                raise InputError(f"{capture.source}: the view {view.name} {fault}")
            if view.name not in first:
                first[view.name] = number
                kept.append(number)
            elif _almost_alike(view.c2w, views[first[view.name]].c2w, reach):
                same[number] = first[view.name]
            else:  # files and tables are written by name
                kept = [other for other in kept if other != first[view.name]]
                raise InputError(f"{capture.source} lists {view.name} more than once, with different poses.")
    capture.left_out.require_enough(len(kept))
    splits = capture.splits and {
        split: tuple(dict.fromkeys(same.get(number, number) for number in numbers))
        for split, numbers in capture.splits.items()
    }
    return _with_known_depths(_with_sound_lenses(replace(capture, views=views, splits=splits).some(kept)))


def cameras_as_given(capture: Capture) -> Cameras:
    """Return the cameras of a capture as given by its format (float64), at the sizes that they are valid for."""

    def column(name: str) -> Tensor:
        return torch.tensor([getattr(view, name) for view in capture.views], dtype=torch.float64)

    width, height = column("size").round().long().unbind(dim=-1)
    return Cameras(
        c2w=torch.stack([view.c2w for view in capture.views]),
        focal=column("focal"),
        center=column("center"),
        lens=column("lens"),
        lens_model=capture.lens_model,
        width=width,
        height=height,
    )


def _with_sound_lenses(capture: Capture) -> Capture:
    """Return the capture without the views whose lens cannot be inverted (`geometry.lens_checks`)."""
    views = capture.views
    if not views:
        return capture
    faults = lens_faults(cameras_as_given(capture), [view.name for view in views])
    capture.left_out.faults |= {views[number].name: fault for number, fault in faults.items()}
    kept = [number for number in range(len(views)) if number not in faults]
    capture.left_out.require_enough(len(kept))
    return capture.some(kept)


def _almost_alike(one: Float[Tensor, "3 4"], other: Float[Tensor, "3 4"], reach: float) -> bool:
    """Return whether two poses differ only by rounding; `reach` is the cameras' distance from their center."""
    off = (one - other).abs()
    return float(off[:, :3].max()) <= ROUNDED and float(off[:, 3].max()) <= ROUNDED * reach


def _without_scale(view: View) -> tuple[View, float | None]:
    """Return the view with its rotation's scale removed, and the scale; None if there was none."""
    determinant = float(torch.linalg.det(view.c2w[:, :3])) if bool(torch.isfinite(view.c2w).all()) else 0.0
    scale = max(determinant, 0.0) ** (1 / 3)
    if scale < LEAST_SCALE or abs(scale - 1.0) < ALMOST_ONE:
        return view, None
    c2w = torch.cat([view.c2w[:, :3] / scale, view.c2w[:, 3:]], dim=-1)
    return (replace(view, c2w=c2w), scale) if bool(is_rigid(c2w)) else (view, None)


def impossible_lens(size: tuple[int | float, int | float], focal: tuple[int | float, int | float]) -> str | None:
    """Return why no perspective lens has this picture size (width, height) and these focal lengths; None if one does.

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


def _fault_of(view: View, lens_model: LensModel) -> str | None:
    """Return why the numbers of a view are not a valid camera, with the cure; None if they are."""
    (width, height), (x, y), center = view.size, view.focal, view.center
    numbers = torch.tensor([*view.focal, *center, *view.size, *view.lens], dtype=torch.float64)
    if not bool(torch.isfinite(numbers).all() and torch.isfinite(view.c2w).all()):
        return "has a pose or intrinsics with NaN or infinity. Remove it, or estimate the poses again."
    if max(x, y) > FARTHEST or float(view.c2w[:, 3].abs().max()) > FARTHEST:
        return (
            f"has a focal length or a center beyond {FARTHEST:g}, where numbers become too coarse. Export the cameras "
            "again, in units of about the scene's size."
        )
    if not min(x, y) >= LEAST_FOCAL or min(width, height) < 1:
        return (
            f"has the focal length {x:g}, {y:g} for {width:g} x {height:g} pixels; all must be above 0, and a focal "
            f"length at least {LEAST_FOCAL:g}. Export the intrinsics again."
        )
    if not (0 < center[0] < width and 0 < center[1] < height):
        return (
            f"has its principal point at {center[0]:g}, {center[1]:g}, outside of its {width:g} x {height:g} pixels. "
            "The intrinsics belong to pictures of another size, or are in other units; they must be in pixels of the "
            "given width and height."
        )
    if max(center) <= 1 and min(width, height) > SMALL:
        return (
            f"has its principal point at {center[0]:g}, {center[1]:g} of {width:g} x {height:g} pixels, which looks "
            "like a fraction of the picture: it must be in pixels. Export the intrinsics again."
        )
    if not bool(is_rigid(view.c2w)):
        return (
            "has a pose that is not a rotation and a center, camera to world with axes right, up, back (it scales, "
            "mirrors or shears along some axis). Export it again."
        )
    if lens_model in ("pinhole", "radial_tangential") and (reason := impossible_lens(view.size, view.focal)):
        return f"has {reason}. The focal length must be in pixels of the given width and height, not a fraction."
    return None


def _with_known_depths(capture: Capture) -> Capture:
    """Return the capture without wrong sparse points, and without bounds if one of them is wrong."""
    sound = (capture.points.abs() <= FARTHEST).all(dim=-1)  # not NaN
    if not bool(sound.all()):
        count = int((~sound).sum())
        log.warning(
            "%s: %d of %d sparse points are NaN or beyond %g, and are left out",
            *(capture.source, count, len(sound), FARTHEST),
        )
        capture = capture.some_points(sound)
    if capture.bounds is None:
        return capture
    near, far = capture.bounds.unbind(dim=-1)
    bad = (~((near > 0) & (near < far) & (far < math.inf))).nonzero()[:, 0].tolist()
    if not bad:
        return capture
    log.warning(
        "%s: the depths (bounds) are not used, since those of %d of %d views are not 0 < near < far (%s); scene.near=N "
        "gives the nearest",
        *(capture.source, len(bad), len(near), listed((capture.views[number].name for number in bad), 3)),
    )
    return replace(capture, bounds=None)


def check_step(name: str, value: object) -> None:
    """Refuse a factor or stride that is below 1 or not a whole number; `name` is the setting's."""
    if type(value) is not int or value < 1:
        raise InputError(f"scene.{name} is {value}, but it must be 1 (take everything as it is) or more.")


def check_metres(metres_per_unit: float | None) -> None:
    """Refuse a unit without length, or beyond numerical range."""
    if metres_per_unit is not None and not LEAST_UNIT <= metres_per_unit <= LARGEST_UNIT:
        raise InputError(
            f"scene.metres_per_unit={metres_per_unit}: give the length of one unit of the capture in meters, such as "
            "0.01 for centimeters, or null if it is unknown."
        )


def known_background(name: str) -> Background:
    """Return `name` as a background, or refuse an unknown one."""
    for known in get_args(Background):
        if name == known:
            return known
    raise InputError(f"scene.background is {name!r}; choose one of {', '.join(get_args(Background))}.")


def pose_from_matrix(matrix: object, where: str) -> Float[Tensor, "3 4"]:
    """Return 3 x 4 or 4 x 4 numbers, nested or flat, as a pose (float64); a fourth row must be 0 0 0 1.

    A matrix whose last column is 0 0 0 1 is in column-major order.
    """
    try:
        pose = torch.as_tensor(matrix, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise InputError(f"{where} is not a 4 x 4 matrix of numbers. Export the camera poses again.") from None
    if pose.shape in ((12,), (16,)):
        pose = pose.reshape(-1, 4)
    if pose.shape not in ((3, 4), (4, 4)):
        shape = " x ".join(str(size) for size in pose.shape) or "a single number"
        raise InputError(f"{where} must be a 4 x 4 matrix, but it is {shape}. Export the camera poses again.")
    if not bool(torch.isfinite(pose).all()):
        raise InputError(
            f"{where} holds NaN or infinity: this view has no pose. Remove it, or estimate the poses again."
        )
    last = pose.new_tensor([0.0, 0.0, 0.0, 1.0])
    if len(pose) == 4 and not _alike(pose[3], last) and _alike(pose[:, 3], last):
        pose = pose.mT
    if not _alike(pose[3:], last):
        raise InputError(f"{where} does not end in the row 0 0 0 1. Export the camera poses again.")
    return pose[:3]


def _alike(row: Tensor, wanted: Tensor) -> bool:
    return bool((row - wanted).abs().le(1e-3).all())


def check_scene(scene: SceneRecord, where: str) -> None:
    """Refuse numbers that are not a valid scene, from a reader or a checkpoint; warn about overlapping splits.

    Args:
        scene: of annotated shapes and kinds, and finite.
        where: the file, for messages.

    Raises:
        Mismatch: invalid cameras, content that ends before it begins, an empty box, a frame that is not a similarity,
            or missing views.
        InputError: more than the budgets allow, or a name that cannot be shown.
    """
    names, views = scene.view_names, len(scene.view_names)
    require_within("views", views, where, "views")
    for name in (scene.name, *names, *scene.captures):
        require_printable(name, where)
    if len(set(names)) < views or not names:  # files and tables are written by it
        raise Mismatch("scene.view_names", "names two views alike, or none")
    check_cameras(scene.cameras, "scene.cameras", where)
    reach = torch.cat([scene.near, scene.far, scene.aabb.flatten()]).abs().max()
    if not bool(((scene.near >= 0) & (scene.near < scene.far)).all()):
        raise Mismatch("scene.near", "is not everywhere from 0 to below far")
    if not bool((scene.aabb[0] < scene.aabb[1]).all()) or float(reach) > FARTHEST:
        raise Mismatch("scene.aabb", f"has no inside, or the content reaches beyond {FARTHEST:g}")
    _check_similarity(scene.to_user.double())
    if scene.metres_per_unit is not None and not LEAST_UNIT <= scene.metres_per_unit <= LARGEST_UNIT:
        raise Mismatch("scene.metres_per_unit", "is no length")
    _check_splits(scene, views, where)


def _check_splits(scene: SceneRecord, views: int, where: str) -> None:
    for split, numbers in scene.splits.items():
        if split not in ("train", "val", "test", "sources") or not set(numbers) <= set(range(views)):
            raise Mismatch(f"scene.splits.{split}", f"names views that are not among the {views}")
        if len(set(numbers)) < len(numbers):
            raise Mismatch(f"scene.splits.{split}", "names a view twice")
    if not scene.splits.get("train"):
        raise Mismatch("scene.splits", "has no views to train on")
    held_out = {*scene.splits.get("val", ()), *scene.splits.get("test", ())}
    both = tuple(scene.view_names[view] for view in scene.splits["train"] if view in held_out)
    if both:
        _warn_of_overlap(where, both, len(scene.splits["train"]))
    of = scene.capture_of
    if of is not None and not (len(of) == views and set(of) <= set(range(len(scene.captures)))):
        raise Mismatch("scene.capture_of", f"is not one of {len(scene.captures)} captures for each view")


@cache  # a command may read a checkpoint several times
def _warn_of_overlap(where: str, names: tuple[str, ...], of: int) -> None:
    log.warning(
        "%s: %d of %d training views are also validation or test views (%s), whose scores say nothing about new views.",
        *(for_terminal(where), len(names), of, listed(names, 3)),
    )


def check_cameras(cameras: Cameras, key: str, where: str) -> None:
    """Refuse numbers that are not valid cameras; see `check_scene`.

    Raises:
        Mismatch: a pose that is not a rotation and a center, or an impossible size or lens.
        InputError: a picture of more than `budgets.view_pixels`.
    """
    if not bool(is_rigid(cameras.c2w).all()):
        raise Mismatch(f"{key}.c2w", "holds a pose that is not a rotation and a center")
    sizes = torch.stack([cameras.width, cameras.height]).double()
    if float(sizes.min()) < 1:
        raise Mismatch(f"{key}.width", "is not above 0")
    require_within("view_pixels", int(sizes.prod(dim=0).max()), where, "pixels in one picture")
    for name in ("c2w", "focal", "center", "lens", "ndc"):
        numbers = getattr(cameras, name)
        if numbers is not None and float(numbers.abs().max()) > FARTHEST:
            raise Mismatch(f"{key}.{name}", f"has numbers beyond {FARTHEST:g}")
    if float(cameras.focal.min()) < LEAST_FOCAL or (cameras.ndc is not None and float(cameras.ndc.min()) <= 0):
        raise Mismatch(f"{key}.focal", f"is not at least {LEAST_FOCAL:g}")


def _check_similarity(to_user: Float[Tensor, "4 4"]) -> None:
    unit = unit_of(to_user)
    rotation = torch.cat([to_user[:3, :3] / unit, to_user[:3, 3:]], dim=1)
    last = to_user[3].tolist() == [0.0, 0.0, 0.0, 1.0]
    if not (LEAST_UNIT <= unit <= LARGEST_UNIT and last and bool(is_rigid(rotation))):
        raise Mismatch("scene.to_user", "is not a rotation, a scale and a shift")

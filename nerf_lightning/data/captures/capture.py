"""What a format says of a capture, before any pixel is read: views with poses and intrinsics, sparse points, splits."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.data.captures.checks import FARTHEST, LEAST_FOCAL, impossible_lens, require_different
from nerf_lightning.data.pixels.decoding import Photograph
from nerf_lightning.data.pixels.images import downscaled_size
from nerf_lightning.files.budgets import require_within
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed, require_printable
from nerf_lightning.nerf.geometry.poses import is_rigid
from nerf_lightning.nerf.types.scene import Cameras, LensModel, PixelStore

# Of width and height: how far a picture's scale may differ from one axis to the other.
LARGEST_STRETCH = 0.01

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class View:
    """One photograph with its camera, as the format gives them."""

    name: str
    photograph: Photograph
    c2w: Float[Tensor, "3 4"]
    """Camera to the user's world; right, up, back, centre; float64."""
    focal: tuple[float, float]
    """In pixels of `size`."""
    center: tuple[float, float]
    size: tuple[float, float]
    """(width, height) for which the intrinsics hold; the picture may be a shrunk copy."""
    lens: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, k3, k4, p1, p2."""


@dataclass(frozen=True)
class Capture:
    """A whole capture in the user's own frame."""

    views: tuple[View, ...]
    source: Path
    """The file that lists the views, for messages."""
    lens_model: LensModel = "pinhole"
    points: Float[Tensor, "points 3"] = field(default_factory=lambda: torch.zeros(0, 3, dtype=torch.float64))
    """Sparse points of the reconstruction."""
    bounds: Float[Tensor, "views 2"] | None = None
    """Nearest and farthest depth of content, where the format has them."""
    box: Float[Tensor, "2 3"] | None = None
    """Lower and upper corner of the box that holds the content, where the format has one."""
    splits: dict[str, tuple[int, ...]] | None = None
    """Where the format names them."""
    undo: Float[Tensor, "4 4"] = field(default_factory=lambda: torch.eye(4, dtype=torch.float64))
    """Takes the poses' frame to the frame that the capture's maker knows."""
    left_out: tuple[str, ...] = ()
    """Photographs that have no pose."""


def common_lens_model(kinds: set[LensModel]) -> LensModel | None:
    """Return the model that holds all of these lenses, a scene having one; None where none does.

    A lens without distortion is one with coefficients of 0; fisheyes and panoramas stand alone.

    >>> common_lens_model({"pinhole", "radial_tangential"}), common_lens_model({"pinhole", "fisheye"})
    ('radial_tangential', None)
    """
    if len(kinds) == 1:
        return next(iter(kinds))
    if kinds & {"fisheye", "equirectangular"}:
        return None
    return "radial_tangential" if "radial_tangential" in kinds else "pinhole"


def filtered(capture: Capture, pattern: str | None) -> Capture:
    """Return the views whose names fit a pattern of * and ?.

    Raises:
        InputError: none does.
    """
    if pattern is None:
        return capture
    kept = [number for number, view in enumerate(capture.views) if fnmatch(view.name, pattern)]
    if not kept:
        names = listed((view.name for view in capture.views), cap=5)
        raise InputError(f"scene.frames={pattern!r} fits none of the views of {capture.source}; they are {names}.")
    return _with_views(capture, kept)


def without_impossible_lenses(capture: Capture) -> Capture:
    """Return the capture without the views whose focal length no perspective picture of their size has.

    Raises:
        InputError: none is left; with the first, and its focal length.
    """
    if capture.lens_model not in ("pinhole", "radial_tangential"):
        return capture
    reasons = [impossible_lens(view.size, view.focal) for view in capture.views]
    odd = [(view.name, reason) for view, reason in zip(capture.views, reasons, strict=True) if reason]
    if not odd:
        return capture
    first, reason = odd[0]
    cure = "The focal length must be in pixels of the width and height beside it, not a share of them."
    if len(odd) == len(reasons):
        raise InputError(f"{capture.source}: the view {first} has {reason}; so has every other. {cure}")
    names = listed((name for name, _ in odd), cap=5)
    log.warning("%d of %d views are left out (%s): %s. %s", len(odd), len(reasons), names, reason, cure)
    return _with_views(capture, [number for number, reason in enumerate(reasons) if reason is None])


def _with_views(capture: Capture, kept: Sequence[int]) -> Capture:
    """Return some of the views, in order; the splits follow."""
    place = {number: new for new, number in enumerate(kept)}
    splits = capture.splits and {
        split: tuple(place[number] for number in numbers if number in place)
        for split, numbers in capture.splits.items()
    }
    bounds = None if capture.bounds is None else capture.bounds[kept]
    return replace(capture, views=tuple(capture.views[number] for number in kept), bounds=bounds, splits=splits)


def check_capture(capture: Capture) -> None:
    """Refuse a capture whose numbers cannot be cameras.

    Raises:
        InputError: with the view's name: no views, two of one name, poses that are no rotation, focal lengths that are
            not positive, principal points outside the picture, and numbers that are not finite; sparse points beyond
            `FARTHEST`; a name that is not UTF-8 or holds control characters.
    """
    require_within("views", len(capture.views), str(capture.source), "views")
    if not capture.views:
        raise InputError(f"{capture.source} lists no views, so there is nothing to learn from. Export it again.")
    names = [view.name for view in capture.views]
    require_within("name_characters", max(map(len, names)), str(capture.source), "characters in a name")
    for name in names:  # those that are left out are shown, and nothing is called by them
        require_printable(name, f"A photograph of {capture.source}")
    require_different(names, str(capture.source))
    for view in capture.views:
        _check_view(view, f"{capture.source}: the view {view.name}")
    far = int((~(capture.points.abs() <= FARTHEST)).any(dim=-1).sum())  # NaN, too
    if far:
        raise InputError(
            f"{capture.source}: {far} of the {len(capture.points)} sparse points are NaN or not within {FARTHEST:g} of "
            "the origin, where no digit is left that a picture could show. Remove them, or estimate the poses anew."
        )


def _check_view(view: View, where: str) -> None:
    numbers = torch.tensor([*view.focal, *view.center, *view.size, *view.lens], dtype=torch.float64)
    if not bool(torch.isfinite(numbers).all() and torch.isfinite(view.c2w).all()):
        raise InputError(
            f"{where} has a pose or intrinsics with NaN or infinity. Remove it, or estimate the poses anew."
        )
    if max(view.focal) > FARTHEST or float(view.c2w[:, 3].abs().max()) > FARTHEST:
        raise InputError(
            f"{where} has a focal length or a centre beyond {FARTHEST:g}, where no digit is left that a picture could "
            "show. Export the cameras again, in units of about the scene's size."
        )
    if not min(view.focal) >= LEAST_FOCAL or min(view.size) < 1:
        raise InputError(
            f"{where} has the focal length {view.focal[0]:g}, {view.focal[1]:g} for {view.size[0]:g} x "
            f"{view.size[1]:g} pixels; all must be above 0, and a focal length at least {LEAST_FOCAL:g}. Export the "
            "intrinsics again."
        )
    if not (0 < view.center[0] < view.size[0] and 0 < view.center[1] < view.size[1]):
        raise InputError(
            f"{where} has its principal point at {view.center[0]:g}, {view.center[1]:g}, outside of its "
            f"{view.size[0]:g} x {view.size[1]:g} pixels. The intrinsics belong to pictures of another size, or are "
            "in other units; they must be in pixels of the width and height beside them."
        )
    if not bool(is_rigid(view.c2w)):
        raise InputError(
            f"{where} has a pose that is not a rotation and a centre (it scales, mirrors or shears). Apply the scale "
            "to the centres alone, make sure that the matrix is not transposed, and export it again."
        )


def cameras_of(capture: Capture, files: list[tuple[int, int]], pixels: PixelStore, downscale: int) -> Cameras:
    """Return the cameras at the size of the pixels that were read.

    Args:
        capture: intrinsics for the sizes that the format names.
        files: (width, height) of each picture file.
        pixels: what was read of them.
        downscale: whole factor between the two; what it leaves over was cropped at the right and the bottom.

    Raises:
        InputError: a picture is not a shrunk copy of what its camera describes, or the pixels are another capture's.
    """
    sizes = [downscaled_size(width, height, downscale) for width, height in files]
    if sizes != list(zip(pixels.width.tolist(), pixels.height.tolist(), strict=True)):
        raise InputError(
            f"The pixels that were kept of {capture.source} have other sizes than its photographs: somebody else wrote "
            "them. Remove them from scene.cache_dir (else ~/.cache/nerf_lightning), and the photographs are read anew."
        )

    def column(name: str) -> Tensor:
        return torch.tensor([getattr(view, name) for view in capture.views], dtype=torch.float64)

    scales = []
    for view, (width, height) in zip(capture.views, files, strict=True):
        x, y = width / view.size[0], height / view.size[1]
        # A shrunk picture's size is rounded: allow a pixel on either side.
        slack = LARGEST_STRETCH + 1.0 / min(width, height)
        if abs(x / y - 1.0) > slack:
            raise InputError(
                f"{view.photograph.path} has {width} x {height} pixels, but its camera was calibrated for "
                f"{view.size[0]:g} x {view.size[1]:g}: the sides differ by other factors ({x:.3f} and {y:.3f}). The "
                "picture was cropped, turned or stretched after the poses were estimated; use the original one."
            )
        scales.append((x / downscale, y / downscale))
    scale = torch.tensor(scales, dtype=torch.float64)
    focal = column("focal") * scale
    possible = ((focal >= LEAST_FOCAL) & (focal <= FARTHEST)).all(dim=-1)
    if not bool(possible.all()):
        view = capture.views[possible.tolist().index(False)]
        raise InputError(
            f"{capture.source}: the view {view.name} has a focal length of {view.focal[0]:g}, {view.focal[1]:g} pixels "
            f"of {view.size[0]:g} x {view.size[1]:g}, which no lens has on the picture that is there. Export the "
            "intrinsics again."
        )

    return Cameras(
        c2w=torch.stack([view.c2w for view in capture.views]),
        focal=focal.float(),
        center=(column("center") * scale).float(),
        lens=column("lens").float(),
        lens_model=capture.lens_model,
        width=pixels.width,
        height=pixels.height,
    )

"""Check which lenses can be inverted over their whole image; views with others are left out before training."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.nerf.geometry.cameras import image_plane
from nerf_lightning.nerf.geometry.lenses import at_angle, off_axis, project_plane, stretches, unproject
from nerf_lightning.nerf.types.scene import Cameras

TOLERANCE = 0.01
"""Maximum error in pixels of a position in the image after mapping it to its ray and back."""
STEPS_FROM_AXIS = 8
"""Positions checked between the axis and each position of the grid."""


def lens_faults(cameras: Cameras, names: Sequence[str]) -> dict[int, str]:
    """Return the views whose lens shows one direction at two image positions, or cannot be inverted there, and why.

    The check uses a grid of 33 x 33 positions from border to border of each image. Each must map to its direction and
    back within `TOLERANCE` pixels, and the lens must not fold back between the axis and it: beyond a fold the inverse
    may be exact and still wrong.

    Args:
        cameras: all views; a pinhole is always fine.
        names: names of the views, or of their cameras, for the messages.
    """
    if cameras.lens_model == "pinhole":
        return {}
    exact = cameras.to("cpu").map(lambda x: x.double() if x.is_floating_point() else x)
    rows = torch.cat([exact.lens, exact.focal, exact.center, exact.width[:, None], exact.height[:, None]], dim=-1)
    views_of: dict[tuple[float, ...], list[int]] = {}
    for view, row in enumerate(rows.tolist()):
        views_of.setdefault(tuple(row), []).append(view)
    faults: dict[int, str] = {}
    for views in views_of.values():
        if (fault := _fault(exact, views[0])) is not None:
            message = _message(cameras, views[0], [names[view] for view in views], fault)
            faults |= dict.fromkeys(views, message)
    return faults


def _fault(cameras: Cameras, view: int) -> str | None:
    """Return what is wrong with one lens."""
    model, lens = cameras.lens_model, cameras.lens[view]
    if not bool(torch.isfinite(lens).all()):
        return "has coefficients that are not finite"
    if model == "fisheye" and bool(lens[4:].any()):
        return "has tangential coefficients p1, p2, which the fisheye model does not have"
    plane = image_plane(cameras, view)
    directions = unproject(plane, lens, model)
    angle, heading = off_axis(directions)
    part = torch.arange(1, STEPS_FROM_AXIS + 1)[:, None] / STEPS_FROM_AXIS
    way = at_angle(part * angle, heading.expand(STEPS_FROM_AXIS, -1, -1))
    unfolded = (stretches(way, lens, model)[..., 0] > 0).all(dim=0)
    if not bool(unfolded.all()):
        return f"folds back before it reaches {_innermost(cameras, view, plane, ~unfolded)}"
    missed = ((project_plane(directions, lens, model) - plane) * cameras.focal[view]).norm(dim=-1)
    if not bool((missed <= TOLERANCE).all()):
        return f"cannot be inverted at {_innermost(cameras, view, plane, ~(missed <= TOLERANCE))}"
    return None


def _innermost(cameras: Cameras, view: int, plane: Float[Tensor, "points 2"], bad: Bool[Tensor, "points"]) -> str:
    """Return a description of the bad position that is nearest to the principal point."""
    at = plane[torch.where(bad, plane.norm(dim=-1), torch.inf).argmin()] * cameras.focal[view] + cameras.center[view]
    return f"pixel ({float(at[0]):.0f}, {float(at[1]):.0f})"


def _message(cameras: Cameras, view: int, names: Sequence[str], fault: str) -> str:
    more = f" (one of {len(names)} views with this lens)" if len(names) > 1 else ""
    named = zip(("k1", "k2", "k3", "k4", "p1", "p2"), cameras.lens[view].tolist(), strict=True)
    coefficients = ", ".join(f"{name}={value:.6g}" for name, value in named if value != 0.0)
    focal = ", ".join(f"{value:.6g}" for value in cameras.focal[view].tolist())
    return (
        f"The lens of {names[0]}{more} {fault}: model {cameras.lens_model}, {coefficients}, focal length {focal} "
        f"pixels, image {int(cameras.width[view])} x {int(cameras.height[view])}. Every pixel needs one ray. Check the "
        "coefficients, their order and their units (OpenCV's: for lengths in focal lengths, not in pixels), undistort "
        "the photographs first with `colmap image_undistorter`, or crop them to the part that the lens model fits."
    )

"""From views with cameras and pixels, in the user's frame, to a scene in a working frame."""

import logging
import math
from dataclasses import replace
from typing import Literal, get_args

from nerf_lightning.data.captures.capture import Capture
from nerf_lightning.data.captures.extent import choose_space, extent_of, require_possible
from nerf_lightning.data.captures.known_depths import known_depths
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.frames import points_from_user, poses_from_user, unit_of
from nerf_lightning.nerf.types.scene import Background, Cameras, PixelStore, Scene

Spaces = Literal["auto", "bounded", "ndc", "contracted"]

log = logging.getLogger(__name__)


def check_extent(space: str, near: float | None, far: float | None) -> None:
    """Refuse a space that there is none of, and distances between which nothing lies."""
    if space not in get_args(Spaces):
        raise InputError(f"scene.space={space!r}: choose one of {', '.join(get_args(Spaces))}.")
    if not 0.0 <= (near or 0.0) < math.inf or not (near or 0.0) < (math.inf if far is None else far):
        raise InputError(f"scene.near={near} and scene.far={far}: rays need 0 <= near < far, in the capture's units.")


def scene_of(
    capture: Capture,
    cameras: Cameras,
    pixels: PixelStore,
    splits: dict[str, tuple[int, ...]],
    *,
    name: str,
    space: Spaces,
    near: float | None,
    far: float | None,
    background: Background,
    protocol: dict[str, str],
    metres_per_unit: float | None = None,
) -> Scene:
    """Return a capture as a scene in a working frame: upright, centered, of a handy size.

    Args:
        capture: names, sparse points and bounds, in the user's frame.
        cameras: of its views, in the user's frame (float64), at the size of the pixels.
        pixels: of its views.
        splits: numbers of its views.
        name: of the scene.
        space: how much of the world is modeled; auto: what suits cameras and points.
        near: distance at which content may begin, in the user's units; None: from the capture.
        far: distance at which content ends; None: from the capture.
        background: what lies behind the scene.
        protocol: how the pixels were made.
        metres_per_unit: how many meters a unit of the user's frame is long; None: unknown.

    Raises:
        InputError: cameras and content that leave no room for a scene.
    """
    names = tuple(view.name for view in capture.views)
    chosen, reason = choose_space(space, cameras, capture, pixels.has_transparency, near)
    log.info("%s: space=%s, %s", name, chosen, reason)
    extent = extent_of(capture, cameras, chosen, near, far)
    to_user = capture.undo @ extent.to_user
    depths = known_depths(capture, cameras)
    if depths is not None:
        depths = replace(depths, distance=(depths.distance / unit_of(extent.to_user)).float())
    require_possible(extent, to_user, capture)
    return Scene(
        name=name,
        cameras=replace(cameras, c2w=poses_from_user(cameras.c2w, extent.to_user).float(), ndc=extent.ndc),
        pixels=pixels,
        near=extent.near,
        far=extent.far,
        aabb=extent.aabb,
        splits=splits,
        view_names=names,
        background=background,
        space=chosen,
        depths=depths,
        points=points_from_user(capture.points, extent.to_user).float(),
        to_user=to_user,
        metres_per_unit=metres_per_unit,
        protocol=protocol,
        truth=None,
        left_out=capture.left_out.names,
    )

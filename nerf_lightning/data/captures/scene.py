"""Turn views with cameras and pixels, in the user's frame, into a scene in a working frame."""

import logging
from dataclasses import replace
from typing import Literal, get_args

from nerf_lightning.data.captures.capture import Capture
from nerf_lightning.data.captures.checks import FARTHEST
from nerf_lightning.data.captures.frame_and_extent import choose_space, extent_of, given_extent, require_possible
from nerf_lightning.data.captures.known_depths import known_depths
from nerf_lightning.messages.errors import InputError, require_one_of
from nerf_lightning.nerf.geometry.world_frame import points_from_user, poses_from_user, unit_of
from nerf_lightning.nerf.types.scene import Background, Cameras, PixelStore, Scene, Space

Spaces = Literal["auto", "bounded", "ndc", "contracted"]
Coordinates = Literal["fitted", "given"]

log = logging.getLogger(__name__)


def check_extent(
    space: str, near: float | None, far: float | None, coordinates: str = "fitted", aabb_half: float | None = None
) -> None:
    """Refuse unknown spaces or coordinates, an empty range of distances, and a box without size."""
    require_one_of(get_args(Coordinates), **{"scene.coordinates": coordinates})
    if space not in get_args(Spaces):
        raise InputError(f"scene.space={space!r}: choose one of {', '.join(get_args(Spaces))}.")
    if coordinates == "given" and space == "ndc":
        raise InputError(
            "scene.space=ndc has coordinates of its own. Use scene.coordinates=fitted, or another scene.space."
        )
    if not 0.0 <= (near or 0.0) < (FARTHEST if far is None else far) <= FARTHEST:
        raise InputError(
            f"scene.near={near} and scene.far={far}: rays need 0 <= near < far <= {FARTHEST:g}, in the capture's units."
        )
    if aabb_half is not None and not 0 < aabb_half <= FARTHEST:
        raise InputError(f"scene.aabb_half={aabb_half}: half the side of a box is above 0, and at most {FARTHEST:g}.")


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
    coordinates: Coordinates = "fitted",
    aabb_half: float | None = None,
) -> Scene:
    """Return a capture as a scene, in its own frame or in a working frame: upright, centered, of a convenient size.

    Args:
        capture: names, sparse points and bounds, in the user's frame.
        cameras: of its views, in the user's frame (float64), at the size of the pixels.
        pixels: of its views.
        splits: indices of its views.
        name: of the scene.
        space: how much of the world is modeled; auto: suited to cameras and points.
        near: distance at which content may begin, in the user's units; None: from the capture.
        far: distance at which content ends; None: from the capture.
        background: the color behind the scene.
        protocol: how the pixels were prepared.
        metres_per_unit: length of a unit of the user's frame in meters; None: unknown.
        coordinates: given: keep the capture's own frame, with the given near, far and box.
        aabb_half: half the side of the box around the origin, for given coordinates; None: the capture's box.

    Raises:
        InputError: cameras and content leave no room for a scene.
    """
    names = tuple(view.name for view in capture.views)
    chosen: Space
    if coordinates == "given":
        chosen = "contracted" if space == "contracted" else "bounded"
        extent, c2w = given_extent(capture, near, far, aabb_half), cameras.c2w
    else:
        chosen, reason = choose_space(space, cameras, capture, pixels.has_transparency, near)
        log.info("%s: space=%s, %s", name, chosen, reason)
        extent = extent_of(capture, cameras, chosen, near, far)
        c2w = poses_from_user(cameras.c2w, extent.to_user)
    to_user = capture.undo @ extent.to_user
    depths = known_depths(capture, cameras)
    if depths is not None:
        depths = replace(depths, distance=(depths.distance / unit_of(extent.to_user)).float())
    require_possible(extent, to_user, capture)
    return Scene(
        name=name,
        cameras=replace(cameras, c2w=c2w.float(), ndc=extent.ndc),
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

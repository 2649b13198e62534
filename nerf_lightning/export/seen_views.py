"""Views rendered for their geometry: where the light of each pixel was stopped, and whether views agree about it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.checkpoints import SceneRecord
from nerf_lightning.escaping import for_terminal
from nerf_lightning.evaluation.geometry import normals_from_depth, surface_depth
from nerf_lightning.free_memory import require_memory
from nerf_lightning.geometry.cameras import (
    all_pixels,
    camera_coordinates,
    project,
    rays_through_pixels,
    resized,
)
from nerf_lightning.models.levels import RadianceModel
from nerf_lightning.models.pictures import render_picture
from nerf_lightning.types.scene import Cameras

# Bytes per pixel, measured on the CPU: all rays of a view, what is rendered of them, and their points and normals;
STRAIGHT = 250
# where rays go through normalised device coordinates.
BENT = 370


@dataclass(frozen=True)
class SeenView:
    """One rendered view, world geometry in the working frame, on the CPU."""

    rgb: Float[Tensor, "height width 3"]
    opacity: Float[Tensor, "height width"]
    depth: Float[Tensor, "height width"]
    """Distance along the ray at which the stopped light was stopped."""
    points: Float[Tensor, "height width 3"]
    normals: Float[Tensor, "height width 3"]
    """Unit, facing the camera; zero where the depth has no slope to speak of."""


def require_room(cameras: Cameras, views: Sequence[int], names: Sequence[str]) -> None:
    """Refuse views whose rays take more memory than can be had, before the first of them is made.

    Raises:
        InputError: with the largest view, and what would fit.
    """
    each = BENT if cameras.ndc is not None else STRAIGHT
    sizes = {view: int(cameras.width[view]) * int(cameras.height[view]) for view in views}
    view = max(sizes, key=lambda view: sizes[view])
    require_memory(
        f"The view {for_terminal(names[view])} has {int(cameras.width[view])} x {int(cameras.height[view])} pixels and "
        "is rendered as a whole",
        sizes[view],
        lambda pixels: each * pixels,
        lambda pixels: f"Views of up to {pixels:,} pixels",
    )


def see(model: RadianceModel, record: SceneRecord, cameras: Cameras, view: int, tile_points: int) -> SeenView:
    """Render one view; `cameras` are the record's, at whatever size."""
    picture = render_picture(model, cameras, view, record.near, record.far, record.background, tile_points)
    depth = picture.depth
    if cameras.ndc is None:
        # In normalised device coordinates light that escapes has no distance that could be taken out.
        depth = surface_depth(depth, picture.opacity, record.far[view].expand(depth.shape))
    rays = rays_through_pixels(replace(cameras, ndc=None), all_pixels(cameras, view), record.near, record.far)
    points = rays.origins + depth[..., None] * rays.directions
    normals = normals_from_depth(points) if min(depth.shape) > 1 else torch.zeros_like(points)
    return SeenView(picture.rgb, picture.opacity, depth, points, normals)


def at_most(cameras: Cameras, longest: int) -> Cameras:
    """Return the cameras for pictures whose longer side has at most `longest` pixels."""
    share = (longest / torch.maximum(cameras.width, cameras.height)).clamp(max=1.0)
    width, height = ((share * size).round().long().clamp(min=1) for size in (cameras.width, cameras.height))
    return resized(cameras, width, height)


def nearest_views(cameras: Cameras, view: int, others: Sequence[int], count: int) -> list[int]:
    """Return those of the other views that were taken from nearest."""
    rest = [other for other in others if other != view]
    apart = (cameras.c2w[rest, :, 3] - cameras.c2w[view, :, 3]).norm(dim=-1)
    return [rest[i] for i in apart.argsort()[:count].tolist()]


def num_agreeing(
    points: Float[Tensor, "points 3"],
    cameras: Cameras,
    depths: dict[int, Float[Tensor, "_ _"]],
    views: Sequence[int],
    tolerance: float,
) -> Int[Tensor, "points"]:
    """Return how many of the views see each point as their surface, within a share `tolerance` of the distance.

    Args:
        points: in the working frame.
        cameras: of all views.
        depths: of each view that may be asked; inf where nothing opaque is seen.
        views: those to ask.
        tolerance: of the distance.
    """
    count = torch.zeros(len(points), dtype=torch.int64)
    for view in views:
        count += _sees(points, cameras, view, depths[view], tolerance).long()
    return count


def _sees(points: Tensor, cameras: Cameras, view: int, depth: Tensor, tolerance: float) -> Bool[Tensor, "points"]:
    local = camera_coordinates(cameras, view, points)
    distance = local.norm(dim=-1)
    place = project(cameras, view, points)
    height, width = depth.shape
    ahead = (local[:, 2] < 0) & (place >= 0).all(dim=-1) & (place[:, 0] < width) & (place[:, 1] < height)
    x, y = torch.where(ahead[:, None], place, 0.0).long().unbind(dim=-1)
    return ahead & ((depth[y, x] - distance).abs() <= tolerance * distance)

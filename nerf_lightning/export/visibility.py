"""Compute what the photographs show: where each pixel's light was absorbed, and whether views agree.

How opaque a surface must be: `min_opacity` in conf/export.yaml.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.compute.machine import require_memory
from nerf_lightning.messages.escaping import for_terminal
from nerf_lightning.nerf.geometry.cameras import camera_coordinates, seen_at
from nerf_lightning.nerf.geometry.surfaces import normals_from_depth
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import picture_surface, render_picture
from nerf_lightning.nerf.types.scene import Cameras, SceneRecord

# Bytes per pixel, measured on the CPU: all rays of a view, their rendering, and their points and normals; and the same
# for rays in normalized device coordinates.
STRAIGHT, BENT = 250, 370


@dataclass(frozen=True)
class SeenView:
    """One rendered view, world geometry in the working frame, on the CPU."""

    rgb: Float[Tensor, "height width 3"]
    opacity: Float[Tensor, "height width"]
    depth: Float[Tensor, "height width"]
    """Distance along the ray at which the light was absorbed."""
    points: Float[Tensor, "height width 3"]
    normals: Float[Tensor, "height width 3"]
    """Unit normals facing the camera; zero where the depth has no reliable slope."""
    channels: dict[str, Float[Tensor, "height width _"]]
    """Other outputs of the model's field, by name."""

    def surface_depth(self, min_opacity: float) -> Float[Tensor, "height width"]:
        """Return the depth of what is opaque; inf where nothing is."""
        return torch.where((self.opacity > min_opacity) & self.depth.isfinite(), self.depth, torch.inf)


def require_room(cameras: Cameras, views: Sequence[int], names: Sequence[str]) -> None:
    """Refuse views whose rays need more memory than is available, before the first one is rendered."""
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


def see(model: Model, record: SceneRecord, cameras: Cameras, view: int, tile_points: int) -> SeenView:
    """Render one view; `cameras` are the record's, at any size."""
    rays_of = RayGenerator(cameras, record.near, record.far, names_photographs=model.needs_photographs)
    picture = render_picture(model, rays_of, view, record.background, tile_points)
    depth, points = picture_surface(rays_of, view, picture)
    normals = normals_from_depth(points) if min(depth.shape) > 1 else torch.zeros_like(points)
    return SeenView(picture.rgb, picture.opacity, depth, points, normals, picture.channels)


def nearest_views(cameras: Cameras, view: int, others: Sequence[int], count: int) -> list[int]:
    """Return the `count` nearest of the other views."""
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
    """Return how many of the views see each point, in the working frame, as their surface.

    `depths` are along each pixel's ray to the surface (scene units), inf where nothing opaque is seen. A point may be
    off by `tolerance` times its distance.
    """
    count = torch.zeros(len(points), dtype=torch.int64)
    for view in views:
        distance = camera_coordinates(cameras, view, points).norm(dim=-1)
        inside, x, y = seen_at(cameras, view, points)
        count += inside & ((depths[view][y, x] - distance).abs() <= tolerance * distance)
    return count

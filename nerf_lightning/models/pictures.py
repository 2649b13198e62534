"""Whole views: render every pixel of a camera, a chunk of rays at a time."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.geometry.cameras import all_pixels, rays_through_pixels
from nerf_lightning.geometry.ndc import world_distance
from nerf_lightning.models.levels import RadianceModel
from nerf_lightning.rendering.blending import background_colors
from nerf_lightning.types import Background, Cameras, RayBundle, TensorStruct


@dataclass(frozen=True)
class Picture(TensorStruct):
    """One rendered view, on the CPU."""

    rgb: Float[Tensor, "height width 3"]
    depth: Float[Tensor, "height width"]
    """Expected distance along the ray; light that escapes ends at far."""
    opacity: Float[Tensor, "height width"]


def tiles(num_rays: int, tile_rays: int) -> Iterator[slice]:
    """Return the slices that cut a batch into tiles of at most `tile_rays`, of sizes as equal as can be.

    >>> [(part.start, part.stop) for part in tiles(10, 4)]
    [(0, 4), (4, 7), (7, 10)]
    """
    count = max(1, -(-num_rays // tile_rays))
    size, rest = divmod(num_rays, count)
    start = 0
    for number in range(count):
        stop = start + size + int(number < rest)
        yield slice(start, stop)
        start = stop


def tile_rays_for(model: RadianceModel, tile_points: int, training: bool = False) -> int:
    """Return how many rays make a tile of about `tile_points` points, at least one."""
    return max(1, int(tile_points / model.points_per_ray(training)))


@torch.no_grad()
def render_picture(
    model: RadianceModel,
    cameras: Cameras,
    view: int,
    near: Float[Tensor, "views"],
    far: Float[Tensor, "views"],
    background: Background,
    tile_points: int,
) -> Picture:
    """Render one view with the last level, as at evaluation (no jitter)."""
    device = next(model.parameters()).device
    pixels = all_pixels(cameras, view)
    shape = pixels.x.shape
    rays = rays_through_pixels(cameras, pixels.map(torch.flatten), near, far)
    parts = [
        _render_tile(model, rays[part].to(device), background)
        for part in tiles(rays.near.numel(), tile_rays_for(model, tile_points))
    ]
    rgb, depth, opacity = (torch.cat(column) for column in zip(*parts, strict=True))
    if cameras.ndc is not None:
        straight = rays_through_pixels(replace(cameras, ndc=None), pixels.map(torch.flatten), near, far)
        depth = world_distance(straight, depth / rays.far)
    return Picture(rgb.view(*shape, 3), depth.view(shape), opacity.view(shape))


def _render_tile(model: RadianceModel, rays: RayBundle, background: Background) -> tuple[Tensor, Tensor, Tensor]:
    behind = background_colors(background, rays.near.numel(), rays.near.device, random=None)
    last = model(rays, behind, random=None)[-1]
    return last.rgb.cpu(), last.depth.cpu(), last.opacity.cpu()

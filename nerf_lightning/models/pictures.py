"""Whole views: render every pixel of a camera, a chunk of rays at a time."""

import logging
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.geometry.cameras import all_pixels, rays_through_pixels
from nerf_lightning.geometry.ndc import world_distance
from nerf_lightning.models.levels import RadianceModel
from nerf_lightning.models.tiles import is_out_of_memory, tile_rays_for, tiles
from nerf_lightning.rendering.blending import background_colors
from nerf_lightning.types import Background, Cameras, RayBundle, TensorStruct

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Picture(TensorStruct):
    """One rendered view, on the CPU."""

    rgb: Float[Tensor, "height width 3"]
    depth: Float[Tensor, "height width"]
    """Expected distance along the ray; light that escapes ends at far."""
    opacity: Float[Tensor, "height width"]


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
    pixels = all_pixels(cameras, view)
    shape = pixels.x.shape
    rays = rays_through_pixels(cameras, pixels.map(torch.flatten), near, far)
    rgb, depth, opacity = render_rays(model, rays, background, tile_points)
    if cameras.ndc is not None:
        straight = rays_through_pixels(replace(cameras, ndc=None), pixels.map(torch.flatten), near, far)
        depth = world_distance(straight, depth / rays.far)
    return Picture(rgb.view(*shape, 3), depth.view(shape), opacity.view(shape))


@torch.no_grad()
def render_rays(
    model: RadianceModel, rays: RayBundle, background: Background, tile_points: int
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"], Float[Tensor, "rays"]]:
    """Return colour, depth and opacity of rays on the CPU; where memory is short, fewer rays at once."""
    device = next(model.parameters()).device
    at_once = min(tile_rays_for(model, tile_points), rays.near.numel())
    if model.most_rays is not None:
        at_once = min(at_once, model.most_rays)
    while True:
        try:
            parts = [_render_tile(model, rays[p].to(device), background) for p in tiles(rays.near.numel(), at_once)]
            rgb, depth, opacity = (torch.cat(column) for column in zip(*parts, strict=True))
            return rgb, depth, opacity
        except RuntimeError as error:
            if at_once == 1 or not is_out_of_memory(error):
                raise
        model.most_rays = at_once = at_once // 2
        log.warning("no memory to render so many rays at once: from now on %d", at_once)


def _render_tile(model: RadianceModel, rays: RayBundle, background: Background) -> tuple[Tensor, Tensor, Tensor]:
    behind = background_colors(background, rays.near.numel(), rays.near.device, random=None)
    last = model(rays, behind, random=None)[-1]
    return last.rgb.cpu(), last.depth.cpu(), last.opacity.cpu()

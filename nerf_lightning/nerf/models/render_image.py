"""Whole views: render every pixel of a camera, a chunk of rays at a time; how many, `tiles.py` computes."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from threading import Lock

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.cameras import pixels_between
from nerf_lightning.nerf.geometry.clipping import Clip
from nerf_lightning.nerf.geometry.ndc import world_distance
from nerf_lightning.nerf.geometry.quads import QUAD, from_quads, pixels_in_quads, quads_between
from nerf_lightning.nerf.geometry.surfaces import surface_depth
from nerf_lightning.nerf.kernels.render.workspace import forget_workspaces
from nerf_lightning.nerf.kernels.threads import FEWEST_ROWS, PARTS_PER_THREAD, in_parallel, threads_on
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.tiles import is_out_of_memory, tile_rays_for, tiles
from nerf_lightning.nerf.rendering.background import background_colors
from nerf_lightning.nerf.row_chunks import row_chunks
from nerf_lightning.nerf.types.rays import PixelIndex, RayBundle
from nerf_lightning.nerf.types.scene import Background
from nerf_lightning.nerf.types.tensor_struct import TensorStruct

WHOLE_RAYS = 4096
"""Rays per tile, if kernels process whole rays: what they are processing stays in the caches anyway."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Picture(TensorStruct):
    """One rendered view, or any rays, on the CPU."""

    rgb: Float[Tensor, "*pixels 3"]
    depth: Float[Tensor, "*pixels"]
    """Expected distance along the ray; light that escapes ends at far."""
    opacity: Float[Tensor, "*pixels"]
    first_rgb: Float[Tensor, "*pixels 3"] | None = None
    """The picture of the first level that makes one, if it is not the last."""
    channels: dict[str, Float[Tensor, "*pixels _"]] = field(default_factory=dict)
    """The field's other outputs, by name (`Rendering.channels`)."""


@torch.no_grad()
def render_picture(
    model: Model,
    rays_of: RayGenerator,
    view: int,
    background: Background,
    tile_points: int,
    clip: Clip | None = None,
    seen_from: RayGenerator | None = None,
) -> Picture:
    """Render one view with the last level, as at evaluation (no jitter): the mean of each pixel's rays.

    Args:
        model: in evaluation mode.
        rays_of: the cameras, including the one of this view.
        view: its number.
        background: what is behind the scene.
        tile_points: maximum number of points that go through a field at once.
        clip: the part of the scene that is shown; None: all.
        seen_from: other cameras, whose directions determine the color instead of the view's own.
    """
    cameras, subpixels, device = rays_of.cameras, model.subpixels, next(model.parameters()).device

    def through(offset: Float[Tensor, "2"] | None, pixels: PixelIndex) -> Picture:
        at = (offset, subpixels.per_side)
        rays, straight = view_rays(rays_of, pixels, clip, *at)
        if seen_from is not None:
            rays = replace(rays, view_directions=view_rays(seen_from, pixels, None, *at)[1].view_directions)
        shown = replace(rays.to(device), together=QUAD)
        seen = (_render_tile if clip is None else _render_what_is_left)(model, shown, background)
        if cameras.ndc is not None:
            whole = rays.far if clip is None else view_rays(rays_of, pixels, None, *at)[0].far
            seen = replace(seen, depth=world_distance(straight.to("cpu"), seen.depth / whole.cpu()))
        return seen

    def render(part: slice) -> Picture:
        pixels = quads_between(cameras, view, part)
        first, *others = subpixels.offsets() if subpixels.per_pixel > 1 else (None,)  # kernels do not support offsets
        total = through(first, pixels)
        for offset in others:
            total = _sum(total, through(offset, pixels))
        return total.map(lambda each: each / subpixels.per_pixel) if others else total

    height, width = int(cameras.height[view]), int(cameras.width[view])
    picture = _in_tiles(model, pixels_in_quads(height, width), tile_points, render, QUAD)
    return picture.map(lambda column: from_quads(column, height, width))


@torch.no_grad()
def view_rays(
    rays_of: RayGenerator,
    pixels: PixelIndex,
    clip: Clip | None = None,
    subpixel_offset: Float[Tensor, "2"] | None = None,
    per_side: int = 1,
) -> tuple[RayBundle, RayBundle]:
    """Return the rays of pixels as the model takes them, and the same rays through the world.

    They are on the cameras' device, or on the CPU if clipped. They take 60 times as much memory as the pixels of a
    photograph: request a tile of a picture at a time.

    Args:
        rays_of: the cameras.
        pixels: the pixels.
        clip: the part of the scene that is shown; None: all.
        subpixel_offset: each ray's offset from the center of its pixel, in pixels (x, y); None: none.
        per_side: number of rays along each side of a pixel.
    """
    subpixel_offset = None if subpixel_offset is None else subpixel_offset.to(pixels.x.device)
    rays, bent = rays_of(pixels, subpixel_offset, per_side), rays_of.ndc is not None
    straight = rays_of.through_world(pixels, subpixel_offset) if bent else rays
    if clip is None:
        return rays, straight
    rays = rays.to("cpu")
    straight = straight.to("cpu") if bent else rays
    return clip(rays, straight, ndc=bent), straight


@torch.no_grad()
def picture_surface(
    rays_of: RayGenerator, view: int, picture: Picture, clip: Clip | None = None
) -> tuple[Float[Tensor, "height width"], Float[Tensor, "height width 3"]]:
    """Return the distance at which the light of each pixel was stopped, and that point in the world; on the CPU.

    In normalized device coordinates, light that escapes has no distance that could be removed.

    Args:
        rays_of: the cameras that the picture was rendered through.
        view: index of the view.
        picture: the rendered picture.
        clip: the part of the scene that it shows; None: all.
    """
    cameras = rays_of.cameras
    depth, opacity = picture.depth.flatten(), picture.opacity.flatten()
    surface, points = torch.empty_like(depth), torch.empty(len(depth), 3)
    for part in row_chunks(len(depth), 1):
        rays, straight = view_rays(rays_of, pixels_between(cameras, view, part), clip)
        bent = cameras.ndc is not None
        surface[part] = depth[part] if bent else surface_depth(depth[part], opacity[part], rays.far.cpu())
        points[part] = straight.origins.cpu() + surface[part, None] * straight.directions.cpu()
    return surface.view(picture.depth.shape), points.view(picture.rgb.shape)


@torch.no_grad()
def render_rays(model: Model, rays: RayBundle, background: Background, tile_points: int) -> Picture:
    """Render rays as at evaluation, and return the result on the CPU.

    Depth is in the rays' units. Rays of which nothing is left (far is not beyond near) see the background. Rays that
    share samples (`together`) are not separated.
    """
    device = next(model.parameters()).device

    def render(part: slice) -> Picture:
        return _render_what_is_left(model, rays[part].to(device), background)

    return _in_tiles(model, rays.near.numel(), tile_points, render, rays.together)


def _in_tiles(
    model: Model, count: int, tile_points: int, render: Callable[[slice], Picture], group_size: int = 1
) -> Picture:
    """Return what `render` sees of `count` rays, tile by tile, with ever smaller tiles if memory runs out.

    Tiles do not separate rays that belong together.
    """
    at_once = tile_rays_for(model, tile_points)
    if model.takes_whole_rays(next(model.parameters()).device, training=False):
        at_once = max(at_once, WHOLE_RAYS)
    at_once = min(at_once, count)
    if model.most_rays is not None:
        at_once = min(at_once, model.most_rays)
    while True:
        try:
            return _fill(model, count, at_once, render, group_size)
        except RuntimeError as error:
            if at_once <= group_size or not is_out_of_memory(error):
                raise
        forget_workspaces()
        model.most_rays = at_once = at_once // 2
        log.warning("out of memory: rendering %d rays at a time from now on", at_once)


def _fill(model: Model, count: int, at_once: int, render: Callable[[slice], Picture], group_size: int) -> Picture:
    # Allocated once: thousands of small results among temporaries would fragment memory to many times their size.
    first_rgb = None if model.first_picture is None else torch.empty(count, 3)
    picture, making = Picture(torch.empty(count, 3), torch.empty(count), torch.empty(count), first_rgb), Lock()

    def fill(part: slice) -> None:
        seen = render(part)
        with making:
            for name, values in seen.channels.items():
                picture.channels.setdefault(name, torch.zeros(count, values.shape[1]))
        picture.rgb[part], picture.depth[part], picture.opacity[part] = seen.rgb, seen.depth, seen.opacity
        if picture.first_rgb is not None and seen.first_rgb is not None:
            picture.first_rgb[part] = seen.first_rgb
        for name, values in seen.channels.items():
            picture.channels[name][part] = values

    threads = threads_on(next(model.parameters()).device)
    if threads > 1:  # share small pictures among threads, too
        at_once = min(at_once, max(FEWEST_ROWS, -(-count // (PARTS_PER_THREAD * threads))))
    parts = list(tiles(count, at_once, group_size, multiple=threads))
    if threads > 1:
        in_parallel(fill, parts)
    else:
        for part in parts:
            fill(part)
    return picture


def _sum(one: Picture, other: Picture) -> Picture:
    more = iter(other.tensors())
    return one.map(lambda each: each + next(more))


def _render_what_is_left(model: Model, rays: RayBundle, background: Background) -> Picture:
    """Render the rays of which something is left; the others see the background."""
    count, left = rays.near.numel(), (rays.far > rays.near).nonzero()[:, 0]
    if left.numel() == count:
        return _render_tile(model, rays, background)
    behind = background_colors(background, count, torch.device("cpu"), random=None)
    empty = torch.zeros(count, 3) if behind is None else behind
    first_rgb = None if model.first_picture is None else empty.clone()
    picture = Picture(empty, rays.far.cpu().clone(), torch.zeros(count), first_rgb)
    if left.numel():
        seen, left = _render_tile(model, replace(rays[left], together=1), background), left.cpu()
        picture.channels.update({name: torch.zeros(count, each.shape[1]) for name, each in seen.channels.items()})
        for column, part in zip(picture.tensors(), seen.tensors(), strict=True):
            column[left] = part.to(column)
    return picture


def _render_tile(model: Model, rays: RayBundle, background: Background) -> Picture:
    behind = background_colors(background, rays.near.numel(), rays.near.device, random=None)
    levels = model(rays, behind, random=None)
    last, first = levels[-1], model.first_picture
    first_rgb = None if first is None else levels[first].rgb
    return Picture(last.rgb, last.depth, last.opacity, first_rgb, last.channels).to("cpu")

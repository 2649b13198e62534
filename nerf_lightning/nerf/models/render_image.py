"""Whole views: render every pixel of a camera, a chunk of rays at a time."""

import logging
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.cameras import all_pixels
from nerf_lightning.nerf.geometry.clipping import Clip
from nerf_lightning.nerf.geometry.ndc import world_distance
from nerf_lightning.nerf.kernels.threads import FEWEST_ROWS, PARTS_PER_THREAD, in_parallel, threads_on
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.tiles import is_out_of_memory, tile_rays_for, tiles
from nerf_lightning.nerf.rendering.blending import background_colors
from nerf_lightning.nerf.types.rays import PixelIndex, RayBundle
from nerf_lightning.nerf.types.scene import Background
from nerf_lightning.nerf.types.tensor_struct import TensorStruct

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Picture(TensorStruct):
    """One rendered view, on the CPU."""

    rgb: Float[Tensor, "height width 3"]
    depth: Float[Tensor, "height width"]
    """Expected distance along the ray; light that escapes ends at far."""
    opacity: Float[Tensor, "height width"]
    first_rgb: Float[Tensor, "height width 3"] | None = None
    """What the first level sees that makes pictures, where it is not the last."""


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
        rays_of: the cameras, the one of this view among them.
        view: its number.
        background: what lies behind the scene.
        tile_points: most points that go through a field at once.
        clip: what of the scene is shown; None: all.
        seen_from: other cameras, from whose directions the colour is looked up, in place of the view's own.
    """
    parts = [
        _render_through(place, model, rays_of, view, background, tile_points, clip, seen_from)
        for place in model.subpixels.places()
    ]
    if len(parts) == 1:
        return Picture(*parts[0])
    return Picture(*(torch.stack(columns).mean(dim=0) for columns in zip(*parts, strict=True)))


@torch.no_grad()
def view_rays(
    rays_of: RayGenerator,
    view: int,
    clip: Clip | None = None,
    place: Float[Tensor, "2"] | None = None,
    per_side: int = 1,
) -> tuple[RayBundle, RayBundle]:
    """Return a picture of rays as the model takes them, and the same rays through the world; both on the CPU.

    Args:
        rays_of: the cameras.
        view: which.
        clip: what of the scene is shown; None: all.
        place: where in each pixel its ray goes through, in pixels from the centre; None: there.
        per_side: so many rays share each side of a pixel.
    """
    cameras = rays_of.cameras
    pixels = all_pixels(cameras, view)
    place = None if place is None else place.to(pixels.x.device)
    rays = rays_of(pixels, place, per_side).to("cpu")
    straight = rays if cameras.ndc is None else rays_of.through_world(pixels, place).to("cpu")
    if clip is not None:
        rays = clip(rays, straight, ndc=cameras.ndc is not None)
    return rays, straight


@torch.no_grad()
def surface_points(
    model: Model, rays_of: RayGenerator, pixels: PixelIndex, tile_points: int
) -> tuple[Float[Tensor, "pixels 3"], Float[Tensor, "pixels"]]:
    """Return where in the world the light of pixels comes from, at the expected depth, and their opacity; on the CPU.

    Args:
        model: in evaluation mode.
        rays_of: the cameras.
        pixels: any pixels of any views.
        tile_points: most points that go through a field at once.
    """
    pixels = pixels.to(rays_of.near.device)
    rays = rays_of(pixels).to("cpu")
    _, depth, opacity, *_ = render_rays(model, rays, "black", tile_points)
    if rays_of.cameras.ndc is None:
        return rays.origins + depth[:, None] * rays.directions, opacity
    straight = rays_of.through_world(pixels).to("cpu")
    return straight.origins + world_distance(straight, depth / rays.far)[:, None] * straight.directions, opacity


def _render_through(
    place: Float[Tensor, "2"],
    model: Model,
    rays_of: RayGenerator,
    view: int,
    background: Background,
    tile_points: int,
    clip: Clip | None,
    seen_from: RayGenerator | None,
) -> list[Tensor]:
    """Return a picture's colour, depth, opacity and first colour, by rays through one place of each pixel."""
    at = (place, model.subpixels.per_side)
    rays, straight = view_rays(rays_of, view, clip, *at)
    if seen_from is not None:
        rays = replace(rays, view_directions=view_rays(seen_from, view, None, *at)[1].view_directions)
    columns = (_render_all if clip is None else render_rays)(model, rays.map(_flat), background, tile_points)
    shape = rays.near.shape
    rgb, depth, opacity, *first = (column.view(*shape, *column.shape[1:]) for column in columns)
    if rays_of.cameras.ndc is not None:
        whole = rays.far if clip is None else view_rays(rays_of, view, None, *at)[0].far
        depth = world_distance(straight, depth / whole)
    return [rgb, depth, opacity, *first]


def _flat(picture: Tensor) -> Tensor:
    return picture.flatten(0, 1)


@torch.no_grad()
def render_rays(model: Model, rays: RayBundle, background: Background, tile_points: int) -> list[Tensor]:
    """Return rays' colour, depth and opacity on the CPU, and the first level's colour where that is a picture too.

    Depth is measured as the rays are. Rays of which nothing is left (far is not beyond near) see the background.
    """
    count = rays.near.numel()
    behind = background_colors(background, count, torch.device("cpu"), random=None)
    empty = torch.zeros(count, 3) if behind is None else behind
    columns = [empty.clone(), rays.far.cpu().clone(), torch.zeros(count)]
    if model.first_picture is not None:
        columns.append(empty.clone())
    shown = (rays.far > rays.near).nonzero()[:, 0]
    if shown.numel():
        rendered = _render_all(model, rays[shown], background, tile_points)
        for column, part in zip(columns, rendered, strict=True):
            column[shown.cpu()] = part.to(column)
    return columns


def _render_all(model: Model, rays: RayBundle, background: Background, tile_points: int) -> list[Tensor]:
    at_once = min(tile_rays_for(model, tile_points), rays.near.numel())
    if model.most_rays is not None:
        at_once = min(at_once, model.most_rays)
    while True:
        try:
            return _render_in_tiles(model, rays, background, at_once)
        except RuntimeError as error:
            if at_once == 1 or not is_out_of_memory(error):
                raise
        model.most_rays = at_once = at_once // 2
        log.warning("no memory to render so many rays at once: from now on %d", at_once)


def _render_in_tiles(model: Model, rays: RayBundle, background: Background, at_once: int) -> list[Tensor]:
    device, count = next(model.parameters()).device, rays.near.numel()
    # Made once: thousands of small results between what comes and goes would leave holes many times their size.
    columns = [torch.empty(count, 3), torch.empty(count), torch.empty(count)]
    if model.first_picture is not None:
        columns.append(torch.empty(count, 3))

    def render(part: slice) -> None:
        for column, result in zip(columns, _render_tile(model, rays[part].to(device), background), strict=True):
            column[part] = result

    threads = threads_on(device)
    if threads > 1:  # small pictures, too, are shared out
        at_once = min(at_once, max(FEWEST_ROWS, -(-count // (PARTS_PER_THREAD * threads))))
    parts = list(tiles(count, at_once, multiple=threads))
    if threads > 1:
        in_parallel(render, parts)
    else:
        for part in parts:
            render(part)
    return columns


def _render_tile(model: Model, rays: RayBundle, background: Background) -> list[Tensor]:
    behind = background_colors(background, rays.near.numel(), rays.near.device, random=None)
    levels = model(rays, behind, random=None)
    last, first = levels[-1], model.first_picture
    columns = [last.rgb.cpu(), last.depth.cpu(), last.opacity.cpu()]
    return columns if first is None else [*columns, levels[first].rgb.cpu()]

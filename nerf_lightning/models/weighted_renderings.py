"""Rendering that keeps the weights along the rays, whatever the kind of level."""

from collections.abc import Iterator

from nerf_lightning.models.levels import RadianceModel
from nerf_lightning.models.tiles import tile_rays_for, tiles
from nerf_lightning.randomness import batch_random
from nerf_lightning.rendering.blending import background_colors
from nerf_lightning.types.rays import RayBundle
from nerf_lightning.types.renderings import DenseRendering, PackedRendering
from nerf_lightning.types.scene import Background


def weighted_renderings(
    model: RadianceModel, rays: RayBundle, background: Background, key: int, tile_points: int
) -> Iterator[tuple[RayBundle, list[DenseRendering | PackedRendering]]]:
    """Render rays as a training step does, without its gradients: tile by tile, each with what every level saw.

    With random numbers a level that leaves out what is empty keeps its weights, which it does not in plain rendering.
    What levels count in training steps is put back at the end.

    Args:
        model: the levels, on the rays' device.
        rays: scene units.
        background: what lies behind them.
        key: of the random numbers.
        tile_points: most points that go through a field at once.
    """
    count = rays.near.numel()
    random = batch_random(key, count, rays.near.device)
    behind = background_colors(background, count, rays.near.device, random)
    counts = [number.clone() for number in model.counts()]
    for part in tiles(count, tile_rays_for(model, tile_points, training=True)):
        yield rays[part], model(rays[part], None if behind is None else behind[part], random[part])
    for number, before in zip(model.counts(), counts, strict=True):
        number.copy_(before)

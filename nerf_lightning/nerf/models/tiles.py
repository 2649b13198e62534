"""Tiles: a batch of rays goes through a model in parts, to limit memory.

Their size: `training/fastest_tile.py`, or what `compute/settings.py` takes without measuring.
"""

from collections.abc import Iterator

import torch

from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.part import sample_counts
from nerf_lightning.nerf.randomness import batch_random
from nerf_lightning.nerf.rendering.background import background_colors
from nerf_lightning.nerf.types.rays import RayBundle
from nerf_lightning.nerf.types.renderings import DenseRendering, RaggedRendering
from nerf_lightning.nerf.types.scene import Background


def tiles(num_rays: int, tile_rays: int, group_size: int = 1, multiple: int = 1) -> Iterator[slice]:
    """Return the slices that cut a batch into tiles of at most `tile_rays`, as equal in size as possible.

    Args:
        num_rays: number of rays of the batch.
        tile_rays: maximum number of rays per tile.
        group_size: this many consecutive rays are never separated; the minimum number per tile.
        multiple: the number of tiles is a multiple of this, if there are enough rays, so that threads have equal
            numbers.

    >>> [(part.start, part.stop) for part in tiles(10, 4)]
    [(0, 4), (4, 7), (7, 10)]
    >>> [(part.start, part.stop) for part in tiles(12, 7, group_size=4)]
    [(0, 4), (4, 8), (8, 12)]
    """
    groups = -(-num_rays // group_size)
    count = max(1, -(-groups // max(1, tile_rays // group_size)))
    count = max(1, min(groups, -(-count // multiple) * multiple))
    size, rest = divmod(groups, count)
    start = 0
    for number in range(count):
        stop = start + size + int(number < rest)
        yield slice(start * group_size, min(stop * group_size, num_rays))
        start = stop


def tile_rays_for(model: Model, tile_points: int, training: bool = False) -> int:
    """Return how many rays make a tile of about `tile_points` points, at least one."""
    return max(1, int(tile_points / model.points_per_ray(training)))


def pixels_in_tile(model: Model, tile_points: int, training: bool = False) -> int:
    """Return how many pixels' rays make a tile of about `tile_points` points, at least one."""
    return max(1, tile_rays_for(model, tile_points, training) // model.subpixels.per_pixel)


def is_out_of_memory(error: RuntimeError) -> bool:
    """Return whether memory ran out for a tensor; smaller tiles may fit."""
    return isinstance(error, torch.OutOfMemoryError) or "can't allocate memory" in str(error)


def is_device_failure(error: BaseException) -> bool:
    """Return whether the GPU itself has failed: its content is lost, and the process can no longer use it."""
    return isinstance(error, torch.AcceleratorError) or str(error).startswith(("CUDA error", "Triton Error [CUDA]"))


def weighted_renderings(
    model: Model, rays: RayBundle, background: Background, key: int, tile_points: int
) -> Iterator[tuple[RayBundle, list[DenseRendering | RaggedRendering]]]:
    """Render rays as a training step does, but without gradients: tile by tile, each with every level's rendering.

    With random numbers, a level that skips empty space keeps its weights, which it does not in plain rendering. The
    levels' counts of training steps are restored at the end.

    Args:
        model: the levels, on the rays' device.
        rays: scene units.
        background: what is behind them.
        key: key of the random numbers.
        tile_points: maximum number of points that go through a field at once.
    """
    count = rays.near.numel()
    random = batch_random(key, count, rays.near.device)
    behind = background_colors(background, count, rays.near.device, random)
    counts = [number.clone() for number in sample_counts(model)]
    for part in tiles(count, tile_rays_for(model, tile_points, training=True)):
        yield rays[part], model(rays[part], None if behind is None else behind[part], random[part])
    for number, before in zip(sample_counts(model), counts, strict=True):
        number.copy_(before)

"""Tiles: a batch of rays goes through a model in parts, so that what is kept for the gradients stays small."""

from collections.abc import Iterator

import torch

from nerf_lightning.models.levels import RadianceModel


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


def is_out_of_memory(error: RuntimeError) -> bool:
    """Tell whether there was no room for a tensor; smaller tiles may find it."""
    return isinstance(error, torch.OutOfMemoryError) or "can't allocate memory" in str(error)

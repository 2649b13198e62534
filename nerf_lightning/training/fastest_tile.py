"""Choose the tile by a short measurement: the number of points that suits this machine's caches and this model."""

import logging
from collections.abc import Callable, Sequence

from nerf_lightning.compute.machine import seconds_of
from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.nerf.models.ragged_level import average_counts
from nerf_lightning.nerf.part import reset_statistics
from nerf_lightning.nerf.types.rays import Batch
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.step import TrainStep

CPU_TILES = (4_096, 8_192, 16_384, 65_536, 262_144)
GPU_TILES = (1 << 18, 1 << 20, 1 << 22)
# Points per tile if kernels process whole rays in the caches: it only bounds memory.
WHOLE_RAYS_TILE = 262_144
# A tile must be faster by this factor to be preferred to a smaller one, which takes less memory.
GAIN = 0.95
# If a tile is this much slower than the fastest, smaller ones are not tried: they only add to what made it slow.
HOPELESS = 1.2
LONGEST_SECONDS = 0.4
# Maximum cost of the trial in steps: shorter runs would spend more on it than it saves.
SHORT_RUN = 50
FEW_RAYS = 16

log = logging.getLogger(__name__)


def measured_tile(settings: TrainerSettings, train_step: TrainStep, batches: RayBatches) -> tuple[int, float | None]:
    """Return the best of a few tile sizes, and about how many seconds a step takes with it.

    Runs training steps that are discarded, for a few seconds at most. None: the tile is known without measuring.
    """
    train_step.objective.to(settings.device)
    model, learns_cameras = train_step.objective.model, train_step.objective.rays.learns_cameras
    if model.takes_whole_rays(train_step.device, training=True, learns_cameras=learns_cameras):
        return WHOLE_RAYS_TILE, None
    batch = batches.batch_at(0, batches.crop_rays(0)).to(settings.device)
    num_rays = _rays_in_time(settings, train_step, batch)
    points = num_rays * model.points_per_ray(training=True)
    tiles = CPU_TILES if settings.device_type == "cpu" else GPU_TILES
    enough = next((number for number, tile in enumerate(tiles) if tile >= points), len(tiles))
    # Tiles larger than the first that takes all points at once would be the same.
    best, seconds = fastest(tiles[: enough + 1], lambda tile: _seconds(settings, train_step, batch, num_rays, tile))
    train_step.objective.zero_grad(set_to_none=True)
    reset_statistics(train_step.objective)
    log.info("tiles of %d points are the fastest of those measured", best)
    return best, seconds * batch.num_rays / num_rays


def fastest(tiles: Sequence[int], seconds: Callable[[int], float]) -> tuple[int, float]:
    """Return the fastest tile (the better of two tries), or a smaller one that takes hardly longer; and its time.

    Large tiles are tried first: small ones take longest to measure, and are best only if large ones do not fit into the
    caches.

    >>> fastest((4, 8, 16), {4: 9.0, 8: 3.0, 16: 2.9}.__getitem__)
    (8, 3.0)
    """
    taken: dict[int, float] = {}
    for tile in reversed(tiles):
        taken[tile] = min(seconds(tile) for _ in range(2))
        if taken[tile] > HOPELESS * min(taken.values()):
            break
    best, best_seconds = 0, float("inf")
    for tile in reversed(taken):
        if taken[tile] < GAIN * best_seconds:
            best, best_seconds = tile, taken[tile]
    return best, best_seconds


def _rays_in_time(settings: TrainerSettings, train_step: TrainStep, batch: Batch) -> int:
    _seconds(settings, train_step, batch, FEW_RAYS, CPU_TILES[0])  # compiles kernels, fills caches
    average_counts(train_step.objective.model)  # the number of samples per ray is known from here on
    # Grown, not extrapolated: a tile of few rays says little about one of many, and with too few rays all tiles are
    # alike.
    rays = min(batch.num_rays, 4 * FEW_RAYS)
    seconds = _seconds(settings, train_step, batch, rays, CPU_TILES[0])
    while rays < batch.num_rays and 4.0 * seconds <= LONGEST_SECONDS:
        rays = min(batch.num_rays, 4 * rays)
        seconds = _seconds(settings, train_step, batch, rays, CPU_TILES[0])
    return max(FEW_RAYS, min(rays, int(rays * LONGEST_SECONDS / seconds)))


def _seconds(settings: TrainerSettings, train_step: TrainStep, batch: Batch, num_rays: int, tile: int) -> float:
    train_step.tiles.points = tile
    some = batch[:num_rays]
    return seconds_of(lambda: train_step.gradients(some, train_step.key))

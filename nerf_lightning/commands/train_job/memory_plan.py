"""How much memory a run takes at most: said before it starts, with what to lower.

Where it runs out, `training/gradients/tiles.py` takes smaller tiles. How much of a GPU the pixels may take is decided
in `data/pixels/placement.py`.
"""

import logging
from dataclasses import dataclass

from nerf_lightning.compute import ranks
from nerf_lightning.compute.machine import free_memory
from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.data.pixels.placement import GIGABYTE, num_bytes
from nerf_lightning.nerf.encoders.base import matrices_of
from nerf_lightning.nerf.kernels.threads import threads_on
from nerf_lightning.nerf.row_chunks import CHUNK_PIXELS
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.step import TrainStep

# A CPU's products in bfloat16 are compiled for each matrix, three ways (forward, two backward) and for two numbers of
# rows as a rule (`matmul_precision.pad_rows`), and kept: 0.7 MB each.
COMPILED_PER_MATRIX = 3 * 2 * 700_000
# Bytes per ray, per pixel, and per point beside its features, each of which is kept a few times over.
RAY_BYTES, PIXEL_BYTES, POINT_BYTES, KEPT = 16_384, 128, 1_024, 6
# And per pixel of a chunk of rows.
CHUNK_BYTES = 1_024
TAKEN = 0.5
"""Models take less than this share of the bound (every yaml of conf/model; tests count what they allocate)."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Need:
    """One kind of thing that takes memory."""

    what: str
    num_bytes: int
    cure: str


def needs(settings: TrainerSettings, train_step: TrainStep, data: RayDataModule) -> list[Need]:
    """Return bounds of what a run holds: several times what it takes."""
    model, pixels, batch = train_step.objective.model, data.scene.pixels, data.batches.progress.largest_batch
    whole = batch * model.points_per_ray(training=True)
    points = whole if settings.tile_points is None else threads_on(settings.device) * settings.tile_points
    matrices = matrices_of(model)
    features = 4 * sum(sum(matrix.shape) for matrix in matrices)
    largest = int((pixels.width * pixels.height).max())
    picture = PIXEL_BYTES * largest + CHUNK_BYTES * min(largest, CHUNK_PIXELS)
    weights = sum(tensor.nbytes for tensor in [*model.parameters(), *model.buffers()])
    # Pixels that stay where they are, in memory or in a mapped file, are not requested again.
    moved = num_bytes(pixels) if data.fits(settings.device) else 0
    on_cpu = settings.device_type == "cpu"
    compiled = COMPILED_PER_MATRIX * len(matrices) if on_cpu and settings.precision == "bf16-mixed" else 0
    tile = "data.batch_rays" if settings.tile_points is None else "trainer.tile_points"
    return [
        Need("the photographs", moved, "lower data.device_budget, or raise scene.downscale"),
        Need("the largest picture", picture, "raise scene.downscale"),
        Need(
            "weights, gradients and the optimizer's state",
            4 * weights + compiled,
            "lower encoder.log2_table_size or field.width, or choose a smaller model",
        ),
        Need("the rays of a step", batch * RAY_BYTES, "lower data.batch_rays"),
        Need("the samples of a step", int(KEPT * points * (features + POINT_BYTES)), f"lower {tile}"),
    ]


def announce_memory(settings: TrainerSettings, train_step: TrainStep, data: RayDataModule) -> None:
    """Warn where memory may be short; the parts are details (-v)."""
    free, parts = free_memory(settings.device), needs(settings, train_step, data)
    # The processes of a CPU share its memory; most of them run on one machine.
    processes = ranks.world_size() if settings.device_type == "cpu" else 1
    most = processes * sum(need.num_bytes for need in parts)
    for need in parts:
        log.debug("memory: at most %.3f GB for %s", need.num_bytes / GIGABYTE, need.what)
    if TAKEN * most > free:
        largest = max(parts, key=lambda need: need.num_bytes)
        log.warning(
            "The run may need up to %.1f GB of memory, but only %.1f GB are free, so the system may stop it. Most of "
            "it is for %s: %s.",
            *(most / GIGABYTE, free / GIGABYTE, largest.what, largest.cure),
        )

"""The memory plan: what a run will hold and where, said before it starts."""

import logging
from dataclasses import dataclass, replace

from nerf_lightning.commands.train_job.memory_trial import Trial, try_out
from nerf_lightning.compute.machine import free_memory, held_memory
from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.data.pixels.mapped_store import MappedPixelStore
from nerf_lightning.data.pixels.placement import GIGABYTE, num_bytes
from nerf_lightning.nerf.encoders.base import matrices_of
from nerf_lightning.nerf.kernels.threads import threads_on
from nerf_lightning.nerf.matmul_precision import cpu_multiplies_bfloat16
from nerf_lightning.nerf.row_chunks import CHUNK_PIXELS
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.step import TrainStep

# What glibc's heap takes beyond what is held, in gaps between blocks of different sizes: 0 to 0.5 of a step, measured.
# Each thread has a heap of its own, and what one has freed no other takes: two threads leave twice as much.
GAPS, MOST_HEAPS = 0.25, 2
# A CPU's products in bfloat16 are compiled for each matrix, three ways (forward, two backward) and for two numbers of
# rows as a rule (products.py: pad_rows), and kept: 0.7 MB each.
COMPILED_PER_MATRIX = 3 * 2 * 700_000
# Smaller shortages are within what a plan can know.
NOTICEABLE = 1.05
# A run that takes a smaller share of what is free needs no word.
SMALL = 0.1
# A bound that needs no trial: bytes per ray, per pixel, and per point beside its features, each of which is kept a few
# times over; what models take lies below the half of it.
RAY_BYTES, PIXEL_BYTES, POINT_BYTES, KEPT = 16_384, 128, 1_024, 6
# And per pixel of a chunk of rows.
CHUNK_BYTES = 1_024

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Row:
    """One kind of thing that takes memory."""

    what: str
    num_bytes: int
    where: str
    counts: bool = True
    """Whether the run must find room for it; a mapped file's pages come and go."""
    cure: str | None = None
    """The setting that makes it smaller."""


@dataclass(frozen=True)
class MemoryPlan:
    """All rows, and the room that there is."""

    rows: list[Row]
    instead: list[Row]
    """Of these only the largest is there at a time."""
    free: int

    @property
    def total(self) -> int:
        """Bytes at the most."""
        return sum(row.num_bytes for row in self.rows if row.counts) + max(row.num_bytes for row in self.instead)

    def __str__(self) -> str:
        def line(what: str, size: int, where: str) -> str:
            return f"  {what:<38} {size / GIGABYTE:8.3f} GB  {where}"

        rows = [*self.rows, self.instead[0], *(replace(row, what=f"or {row.what}") for row in self.instead[1:])]
        lines = [line(row.what, row.num_bytes, row.where) for row in rows]
        total = line("at most, in addition to what is held", self.total, f"{self.free / GIGABYTE:.1f} GB are free")
        return "\n".join(["memory plan:", *lines, total])

    @property
    def warning(self) -> str | None:
        """What to lower where the room is short; None where it is not."""
        if self.total <= NOTICEABLE * self.free:
            return None
        curable = [row for row in [*self.rows, *self.instead] if row.counts and row.cure]
        largest = max(curable, key=lambda row: row.num_bytes)
        needed, free, most = (f"{size / GIGABYTE:.1f} GB" for size in (self.total, self.free, largest.num_bytes))
        return (
            f"The run needs about {needed} of memory, but only {free} are free, so the system may stop it. Most of it "
            f"is {largest.what} ({most}): {largest.cure}."
        )


def memory_plan(settings: TrainerSettings, train_step: TrainStep, data: RayDataModule) -> MemoryPlan:
    """Plan by short trials: what a step and a picture hold is counted and scaled up."""
    device, tile = settings.device, settings.tile_points
    free = free_memory(device)
    trial = try_out(settings, train_step, data.batches, tile)
    pixels = data.scene.pixels
    moves = data.fits(device)
    where = "GPU" if device.type == "cuda" else "memory"
    if moves:
        row = Row("pixels", num_bytes(pixels), where, cure="lower data.device_budget, or raise scene.downscale")
    else:
        # What lies in memory already is not asked for again.
        there = f"mapped file {pixels.path}" if isinstance(pixels, MappedPixelStore) else "memory, there already"
        row = Row("pixels", num_bytes(pixels), there, counts=False)
    compiles = settings.device_type == "cpu" and settings.precision == "bf16-mixed" and cpu_multiplies_bfloat16()
    steps = [_step(trial, tile, where), _picture(trial, data, where)]
    heaps = 0 if device.type == "cuda" else min(MOST_HEAPS, threads_on(device))
    gaps = int(heaps * GAPS * max(row.num_bytes for row in steps))
    tables = "lower encoder.log2_table_size or field.width, or choose a smaller model"
    return MemoryPlan(
        [
            row,
            Row("weights, tables, grids", _weights(train_step), f"{where}, there already", False),
            Row("gradients", trial.gradients, where, cure=tables),
            Row("optimizer's state", trial.optimizer, where, cure=tables),
            Row("gaps in the heap, about", gaps, where),
            *([Row("compiled products, about", _compiled(train_step), where)] if compiles else []),
        ],
        steps,
        free,
    )


def _weights(train_step: TrainStep) -> int:
    model = train_step.objective.model
    return sum(tensor.nbytes for tensor in [*model.parameters(), *model.buffers()])


def _compiled(train_step: TrainStep) -> int:
    return COMPILED_PER_MATRIX * len(matrices_of(train_step.objective.model))


def at_most(settings: TrainerSettings, train_step: TrainStep, data: RayDataModule) -> int:
    """Return bytes that a run surely does not exceed, without a trial: several times what it takes."""
    model, pixels, batch = train_step.objective.model, data.scene.pixels, data.batches.progress.largest_batch
    whole = batch * model.points_per_ray(training=True)
    points = whole if settings.tile_points is None else threads_on(settings.device) * settings.tile_points
    features = 4 * sum(sum(matrix.shape) for matrix in matrices_of(model))
    largest = int((pixels.width * pixels.height).max())
    picture = PIXEL_BYTES * largest + CHUNK_BYTES * min(largest, CHUNK_PIXELS)
    held = num_bytes(pixels) + 4 * _weights(train_step) + _compiled(train_step) + batch * RAY_BYTES + picture
    return int(held + KEPT * points * (features + POINT_BYTES))


def announce_memory(settings: TrainerSettings, train_step: TrainStep, data: RayDataModule) -> None:
    """Log one line of the plan where it is not small, its rows for who asks for details (-v), and where it is short."""
    small = SMALL * free_memory(settings.device)
    if not log.isEnabledFor(logging.DEBUG) and at_most(settings, train_step, data) < small:
        return
    plan = memory_plan(settings, train_step, data)
    for line in str(plan).splitlines():
        log.debug("%s", line)
    if plan.total > SMALL * plan.free:
        log.info(
            "memory: at most about %.1f GB on top of the %.1f GB in use by this process; %.1f GB are free (-v: more)",
            plan.total / GIGABYTE,
            held_memory(settings.device) / GIGABYTE,
            plan.free / GIGABYTE,
        )
    if plan.warning is not None:
        log.warning(plan.warning)


def _step(trial: Trial, tile: int | None, where: str) -> Row:
    if tile is None:
        return Row("a step on a whole batch", trial.batch + trial.activations, where, cure="lower data.batch_rays")
    cure = "lower trainer.tile_points" if trial.activations > trial.batch else "lower data.batch_rays"
    return Row(f"a step in tiles of {tile:,} points", trial.batch + trial.activations, where, cure=cure)


def _picture(trial: Trial, data: RayDataModule, where: str) -> Row:
    pixels = data.scene.pixels
    view = int((pixels.width * pixels.height).argmax())
    what = f"a picture of {int(pixels.width[view])} x {int(pixels.height[view])}"
    return Row(what, trial.picture, where, cure="raise scene.downscale")

"""`nerf bench`: how the time of a step is spent: its stages, waiting for the batch, arithmetic."""

from collections.abc import Callable

import torch
from torch.utils.flop_counter import FlopCounterMode

from nerf_lightning.compute.machine import seconds_of, torch_threads
from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.nerf.kernels.backends import without
from nerf_lightning.nerf.models.ragged_level import RaggedLevel
from nerf_lightning.nerf.rendering.sample_points import ragged_points
from nerf_lightning.nerf.types.rays import Batch
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.step import TrainStep


def stage_seconds(train_step: TrainStep, batch: Batch, optimizer: torch.optim.Optimizer) -> dict[str, float]:
    """Return a packed model's seconds of marching, screening, the rest of both passes, and the update; else nothing.

    If one kernel takes rays from marching to color, there are no stages: both passes are the rest. A replayed step has
    no stages either.
    """
    level = next((part for part in train_step.objective.model.modules() if isinstance(part, RaggedLevel)), None)
    if level is None or train_step.gradients.replays:
        return {}
    rays, sampler = train_step.objective.rays(batch.pixels), level.sampler
    optimizer.zero_grad()
    whole = seconds_of(lambda: train_step.gradients(batch, train_step.key))
    update = seconds_of(optimizer.step)
    if level.takes_whole_rays(rays.near.device, training=True, learns_cameras=train_step.objective.rays.learns_cameras):
        return {"whole rays, loss and gradients": whole, "optimizer": update}
    with torch.no_grad():
        points = ragged_points(rays, sampler(rays, None), None)
        walking, screening = seconds_of(lambda: sampler(rays, None)), seconds_of(lambda: level.field.density(points))
    rest = whole - walking - screening
    return {"march": walking, "screen": screening, "field, loss and gradients": rest, "optimizer": update}


class LoadedSteps:
    """Take `steps` steps at a time with batches from the loader, and record the waiting time for each batch."""

    def __init__(self, batches: RayBatches, train_on: Callable[[Batch], None], steps: int):
        self.batches, self.train_on, self.steps = batches, train_on, steps
        self.stream = iter(batches)
        self.waits: list[float] = []
        """Seconds per step, one number for each call."""

    def __call__(self) -> None:
        """Take the steps."""
        waited = 0.0
        for _ in range(self.steps):
            waited += seconds_of(self._load)
            self.train_on(self.batch.now())
            self.batches.progress.advance(self.batches.progress.batch_rays)
        self.waits.append(waited / self.steps)

    def _load(self) -> None:
        self.batch = next(self.stream)


_ROWS, _WIDTH, _REPEATS = 4096, 256, 20
MATRIX_FLOPS = 2 * _ROWS * _WIDTH**2 * _REPEATS


def multiplication(settings: TrainerSettings) -> Callable[[], None]:
    """Return a function that performs `MATRIX_FLOPS`, in the training precision."""
    dtype = torch.bfloat16 if settings.precision.startswith("bf16") else torch.float32
    left = torch.randn(_ROWS, _WIDTH, device=settings.device).to(dtype)
    right = torch.randn(_WIDTH, _WIDTH, device=settings.device).to(dtype)
    out = torch.empty_like(left)

    def multiply() -> None:
        for _ in range(_REPEATS):
            torch.mm(left, right, out=out)

    return multiply


def flops_per_ray(train_step: TrainStep, batch: Batch) -> float:
    """Count the operations that training takes per ray, forward and backward, in matrix products."""
    # If rays differ in their samples, average over many.
    few = 8 if train_step.objective.model.points_per_ray(training=True) > 64 else min(1024, batch.num_rays)
    rays = batch[:few]
    # It counts torch's own operations, in its own thread.
    kernels = "mlp.cpu", "mlp.cuda", "render.gradients", "render.dense"
    with torch_threads(1), FlopCounterMode(display=False) as counter, without(*kernels):
        train_step.tiles(rays, key=0)
    return counter.get_total_flops() / few

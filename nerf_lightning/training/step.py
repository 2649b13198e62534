"""One training step, which needs torch and no trainer: the gradients of named loss terms change the weights."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.utils import clip_grad_norm_, get_total_norm
from torch.optim import Optimizer

from nerf_lightning.compute import ranks
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.level import Level
from nerf_lightning.nerf.objective import Objective, StepOutput
from nerf_lightning.nerf.optimizers.groups import BuildOptimizer, optimizer_of
from nerf_lightning.nerf.optimizers.schedule import Schedule
from nerf_lightning.nerf.optimizers.table_adam import TableAdam
from nerf_lightning.nerf.part import StepContext, begin_step, buffers_to_average, end_step
from nerf_lightning.nerf.randomness import fold
from nerf_lightning.nerf.samplers.base import RaggedSampler
from nerf_lightning.nerf.types.progress import Progress, batch_size
from nerf_lightning.nerf.types.rays import Batch, LazyBatch
from nerf_lightning.training.gradients.recorded import RecordedGradients, Rest
from nerf_lightning.training.gradients.tiles import Backward, Share, TileGradients, torch_backward
from nerf_lightning.training.step_guard import StepGuard

# The number of rays per step changes at most every this many steps.
BATCH_STEPS = 16


class TrainStep:
    """Take training steps, one after another.

    If a run has several processes, each has its share of the batch, and their gradients are summed once per step.

    Args:
        objective: the loss, and what learns.
        optimizer: builds the optimizer of the parameters.
        schedule: factor on the learning rate as a function of the attempt's step.
        progress: the run's progress, which is updated here and read by the loader.
        seed: the run's seed.
        tile_points: maximum number of points that a tile may send through a field at once; None trains the whole batch
            at once.
        clip_norm: maximum norm of the gradient, to which larger ones are scaled down; None: no clipping.
        sample_budget: approximate number of samples per step, to which the number of rays adapts; None: it does not.
        start_weights: the model's state from which attempts start (`draw_weights`); None: random weights.
        num_steps: the length of the run, which the schedule follows; None: set by the trainer that runs it.
        jitter: False: samples are in the middle of their intervals and one background is behind all rays, as at
            evaluation, so that steps differ only in their pixels.
        records: returns whether to record and replay steps on the weights' present device; None: no.
    """

    def __init__(
        self,
        objective: Objective,
        optimizer: BuildOptimizer,
        schedule: Schedule,
        progress: Progress,
        seed: int,
        tile_points: int | None = None,
        clip_norm: int | float | None = None,
        sample_budget: int | None = None,
        start_weights: dict[str, Tensor] | None = None,
        num_steps: int | None = None,
        jitter: bool = True,
        records: Callable[["TrainStep"], bool] | None = None,
    ):
        self.objective, self.build_optimizer, self.schedule = objective, optimizer, schedule
        self.progress, self.num_steps, self.seed = progress, num_steps, seed
        self.clip_norm, self.sample_budget, self.start_weights = clip_norm, sample_budget, start_weights
        self.tiles, self.guard, self.records = TileGradients(objective, tile_points, jitter), StepGuard(), records
        self.gradients: TileGradients | RecordedGradients = self.tiles
        for part in objective.model.modules():
            if isinstance(part, Level):
                part.returns_weights = objective.loss.needs_weights
            if isinstance(part, RaggedSampler) and sample_budget is not None:
                part.sample_budget = -(-sample_budget // ranks.world_size())

    def __call__(
        self,
        batch: Batch | LazyBatch,
        optimizer: Any,
        backward: Backward = torch_backward,
        measure_gradients: bool = False,
    ) -> StepOutput:
        """Take one step.

        Args:
            batch: this process's share of the step's pixels.
            optimizer: torch's, or Lightning's wrapper of it.
            backward: adds a loss's gradients to the parameters'.
            measure_gradients: whether to measure the gradients' norms, before they are clipped.

        Raises:
            InputError: the length of the run is unknown, or memory runs out.
        """
        objective, progress = self.objective, self.progress
        if self.num_steps is None:
            raise InputError("The length of the run is not known, which the learning rate follows: give num_steps=....")
        with self.tiles.on_threads(self.device):
            optimizer.zero_grad()
            begin_step(objective, StepContext(progress.step / self.num_steps, progress.step, self.key))
            factor = self.schedule(progress.step, self.num_steps)
            for group in optimizer.param_groups:
                group["lr"] = factor * group.setdefault("base_lr", group["lr"])
            if self.gradients is not self.tiles:
                taken, seen = True, self._replayed(self.gradients, batch, optimizer, backward, measure_gradients)
            else:
                batch = batch.now()
                seen = self.tiles(batch, self.key, self._share(), backward)
                self._add_up(seen)
                taken = self.guard.allows(seen.losses, objective.named_weights())
                if taken:
                    seen = self._clipped(seen, measure_gradients)
                    optimizer.step()
            if taken:
                end_step(objective, seen.rgb, seen.target, seen.weight)
                if ranks.world_size() > 1:
                    ranks.average(buffers_to_average(objective.loss))
            progress.advance(progress.batch_rays)
            if progress.step == 1 or progress.step % BATCH_STEPS == 0:
                self._choose_batch()
            return seen

    def _share(self) -> Share | None:
        """Return this process's share of the batch; None: all of it."""
        if ranks.world_size() == 1:
            return None
        first = ranks.share(self.progress.batch_rays // self.objective.pixels_per_patch).start
        return Share(first * self.objective.pixels_per_patch, self.progress.batch_rays)

    def _replayed(
        self, gradients: Any, batch: Batch | LazyBatch, optimizer: Any, backward: Backward, measure_gradients: bool
    ) -> StepOutput:
        """Replay a step, with its update if the optimizer's can be recorded; the guard zeroes nonfinite gradients."""
        inner = getattr(optimizer, "optimizer", optimizer)  # Lightning's wrapper counts the steps
        recorded = inner if isinstance(inner, TableAdam) else None
        outputs: list[StepOutput] = []

        def finish(output: StepOutput) -> StepOutput:
            self.guard.keep_finite(output.losses, self.objective.named_weights())
            output = self._clipped(output, measure_gradients)
            if recorded is not None:
                recorded.update()
            return output

        def compute() -> None:
            update = None if recorded is None else recorded.next_update
            changes = [*self.guard.tensors(batch.device), *(() if update is None else update.tensors())]
            rest = Rest(self._add_up, finish, changes, kind=(measure_gradients, update))
            outputs.append(gradients(batch, self.key, self._share(), backward, rest))
            if recorded is not None:
                recorded.gradients_are_zero()

        optimizer.step(compute)
        return outputs[0]

    def _add_up(self, output: StepOutput) -> None:
        ranks.add_up([output.losses, output.color_errors, *output.terms.values()])
        ranks.add_up_gradients(self.objective.parameters())

    def _clipped(self, output: StepOutput, measure_gradients: bool) -> StepOutput:
        if measure_gradients:
            output = replace(output, gradient_norms=_norms(self.objective.model))
        if self.clip_norm is not None:
            clip_grad_norm_(self.objective.parameters(), self.clip_norm)
        return output

    def _choose_batch(self) -> None:
        """Choose the number of rays of the next steps by the number of samples per ray."""
        progress, model = self.progress, self.objective.model
        ranks.average(buffers_to_average(model))
        if self.sample_budget is not None:
            wanted = self.sample_budget / model.points_per_ray(training=True)
            progress.batch_rays = batch_size(progress.largest_batch, wanted, self.objective.pixels_per_patch)

    def begin_recording(self) -> None:
        """Record and replay steps from now on, if requested and possible.

        Raises:
            InputError: it was requested, but a part decides on the host what a step computes.
        """
        if self.gradients is self.tiles and self.records is not None and self.records(self):
            self.gradients = RecordedGradients(self.tiles)

    def new_optimizer(self) -> Optimizer:
        """Return the optimizer of all parameters.

        Raises:
            InputError: the optimizer refuses a setting.
        """
        return optimizer_of(self.objective, self.build_optimizer)

    @property
    def key(self) -> int:
        """Key of the next step's random numbers."""
        return fold(self.seed, self.progress.attempt, self.progress.step)

    @property
    def device(self) -> torch.device:
        """Where the model is."""
        return next(self.objective.model.parameters()).device


def _norms(model: Model) -> dict[str, Float[Tensor, ""]]:
    """Return the norm of each level's gradients."""
    grads = {name: [each.grad for each in level.parameters()] for name, level in model.rounds().items()}
    return {name: get_total_norm([grad for grad in found if grad is not None]) for name, found in grads.items()}

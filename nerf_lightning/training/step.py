"""One step of training, which needs torch and no trainer: gradients of the objective, clipped, become an update."""

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils import get_total_norm
from torch.optim import Optimizer

from nerf_lightning.compute import ranks
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.level import Level
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.tiles import is_out_of_memory
from nerf_lightning.nerf.objective import Objective, StepOutput
from nerf_lightning.nerf.optimizers.groups import BuildOptimizer, optimizer_of
from nerf_lightning.nerf.optimizers.schedule import Schedule
from nerf_lightning.nerf.part import StepContext, begin_step, buffers_to_average, end_step, parts_of
from nerf_lightning.nerf.randomness import fold
from nerf_lightning.nerf.samplers.base import RaggedSampler
from nerf_lightning.nerf.types.progress import Progress, batch_size
from nerf_lightning.nerf.types.rays import Batch
from nerf_lightning.training.gradients.recorded import RecordedGradients, Recorder, cuda_graph
from nerf_lightning.training.gradients.tiles import Backward, Share, TileGradients, torch_backward
from nerf_lightning.training.step_guard import StepGuard, first_not_finite

# The number of rays per step changes no more often.
BATCH_STEPS = 16
# Points of a tile where pictures are rendered beside steps that are not cut into tiles.
WHOLE_BATCH_POINTS = 65_536

log = logging.getLogger(__name__)


class TrainStep:
    """Take steps of training, one after the other.

    Where a run has several processes, each has its share of the batch, and their gradients are added up once a step.

    Args:
        objective: the loss, and what learns.
        optimizer: takes the parameters.
        schedule: factor on the learning rate as a function of the attempt's step.
        progress: the run's place; it is changed here, and read by the loader.
        seed: the run's seed.
        tile_points: most points that a tile may send through a field at once; None trains the batch whole.
        clip_norm: maximum norm of the gradient, to which larger ones are scaled down; None: no clipping.
        sample_budget: rays per step are chosen so that a step has about so many samples; None leaves them alone.
        start_weights: the model's state to start from; None draws weights, a function of (seed, attempt).
        num_steps: the length of the run, which the schedule follows; None: the trainer that runs it says so.
        jitter: False: samples lie in the middles of their intervals and one background is behind all rays, as at
            evaluation, so that steps differ in their pixels alone.
        records: tells whether to record steps where the weights are now, and to replay them; None: no.

    Raises:
        InputError: several rays a pixel, and a loss that looks at single rays.
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
        self.tiles, self.guard = TileGradients(objective, tile_points, jitter), StepGuard()
        self.records = records
        self.recorded: RecordedGradients | None = None
        model, loss = objective.model, objective.loss
        for part in model.modules():
            if isinstance(part, Level):
                part.returns_weights = loss.needs_weights
            if isinstance(part, RaggedSampler) and sample_budget is not None:
                part.sample_budget = -(-sample_budget // ranks.world_size())
        if model.subpixels.side > 1 and loss.needs_weights:
            raise InputError(
                f"model.subpixels={model.subpixels.side} compares the mean of several rays with a photograph's pixel, "
                f"and the loss {type(loss).__name__} looks at the samples of single rays, as model=fast_proposal wants "
                "it. Leave model.subpixels out, or choose another loss or model."
            )
        self.draw_weights()

    def __call__(
        self, batch: Batch, optimizer: Any, backward: Backward = torch_backward, measure_gradients: bool = False
    ) -> StepOutput:
        """Take one step.

        Args:
            batch: this process's share of the step's pixels.
            optimizer: torch's, or Lightning's wrapper of it.
            backward: adds a loss's gradients to the parameters'.
            measure_gradients: whether to measure the gradients' norms, before they are clipped.
        """
        with self.tiles.on_threads(self.device):
            optimizer.zero_grad()
            begin_step(self.objective, self._context())
            share = self._share(ranks.total(batch.weight.sum()))
            seen = self.gradients(batch, backward, share)
            ranks.add_up([seen.losses, seen.color_errors, *seen.terms.values()])
            ranks.add_up_gradients(self.objective.parameters())
            guarded = self.recorded is not None and self.recorded.guards
            if guarded or self.guard.allows(seen.losses, self.objective.named_weights()):
                if measure_gradients:
                    norms = {name: _norm_of_gradients(part) for name, part in self.model.rounds().items()}
                    seen = replace(seen, gradient_norms=norms)
                self._update(optimizer)
                end_step(self.objective, seen.rgb, seen.target, seen.weight)
                ranks.average(buffers_to_average(self.objective.loss))
            self._advance(share.num_rays)
            return seen

    def gradients(self, batch: Batch, backward: Backward = torch_backward, share: Share | None = None) -> StepOutput:
        """Add a batch's gradients to the parameters', by a replay where steps are recorded.

        Args:
            batch: pixels, colors, weights.
            backward: adds a loss's gradients to the parameters'.
            share: what part of the step's batch this is; None: all of it.

        Returns:
            What this share saw; its losses and errors add up over all shares to the batch's.
        """
        if self.recorded is not None:
            weight = batch.weight.sum() if share is None else share.weight
            try:
                return self.recorded(batch, weight, self._key)
            except RuntimeError as error:
                if not is_out_of_memory(error) and "captur" not in str(error):
                    raise
                cause = "there is no memory" if is_out_of_memory(error) else f"CUDA refuses: {error}".splitlines()[0]
            log.warning("Steps are not recorded: %s. The kernels of each step are launched one by one.", cause)
            self.recorded = None
            self.objective.zero_grad(set_to_none=False)
        return self.tiles(batch, self._key, share, backward)

    def _context(self) -> StepContext:
        if self.num_steps is None:
            raise InputError("The length of the run is not known, which the learning rate follows: give num_steps=....")
        return StepContext(self.progress.step / self.num_steps, self.progress.step, self._key)

    def _update(self, optimizer: Any) -> None:
        if self.clip_norm is not None:
            torch.nn.utils.clip_grad_norm_(self.objective.parameters(), self.clip_norm)
        assert self.num_steps is not None
        factor = self.schedule(self.progress.step, self.num_steps)
        for group in optimizer.param_groups:
            group["lr"] = factor * group.setdefault("base_lr", group["lr"])
        optimizer.step()

    def _advance(self, num_rays: int) -> None:
        progress = self.progress
        progress.advance(num_rays)
        if progress.step == 1 or progress.step % BATCH_STEPS == 0:
            ranks.average(buffers_to_average(self.model))
            if self.sample_budget is not None:
                wanted = self.sample_budget / self.model.points_per_ray(training=True)
                progress.batch_rays = batch_size(progress.largest_batch, wanted, self.objective.together)

    def begin_recording(self) -> None:
        """Record steps from now on, where that was asked for and is possible.

        Raises:
            InputError: it was asked for, and something here decides on the host what a step computes.
        """
        if self.recorded is None and self.records is not None and self.records(self):
            self.record_gradients()

    def record_gradients(self, record: Recorder = cuda_graph) -> None:
        """Record the way forward and back of batches, whole, and replay it from now on.

        Raises:
            InputError: something here decides on the host what a step computes.
        """
        self.recorded = RecordedGradients(self.tiles, self.guard, self._share, record)

    def forget_recordings(self) -> None:
        """Free the memory of all recordings; a further step makes new ones, of where everything lies then."""
        if self.recorded is not None:
            self.recorded.recordings.clear()

    @property
    def model(self) -> Model:
        """What renders."""
        return self.objective.model

    @property
    def rays(self) -> RayGenerator:
        """What makes the rays."""
        return self.objective.rays

    @property
    def device(self) -> torch.device:
        """Where the model is."""
        return next(self.model.parameters()).device

    def to(self, device: torch.device) -> "TrainStep":
        """Move all that is computed with to a device."""
        self.objective.to(device)
        return self

    def new_optimizer(self) -> Optimizer:
        """Return the optimizer of all that learns.

        Raises:
            InputError: a setting of the optimizer that it refuses.
        """
        return optimizer_of(self.objective, self.build_optimizer)

    def draw_weights(self) -> None:
        """Draw the weights of this attempt, or take those that it starts from."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(fold(self.seed, self.progress.attempt, "weights"))
            self.objective.reset_parameters()
        if self.start_weights is not None:
            self.model.load_state_dict(self.start_weights)
        self.forget_recordings()

    def restart(self, optimizer: Optimizer) -> None:
        """Begin a new attempt with fresh weights, optimizer and order of rays."""
        self.progress.restart()
        self.draw_weights()
        optimizer.state.clear()

    def count_rollback(self, former: Progress, skipped: int) -> None:
        """Begin a new attempt, with other random numbers, from the state that was just taken up.

        Args:
            former: where the run stood before.
            skipped: steps that were left out before.
        """
        self.progress.attempt, self.progress.rollbacks = former.attempt + 1, former.rollbacks + 1
        self.forget_recordings()
        self.guard.restore([skipped, 0], self.device)

    def reset_statistics(self) -> None:
        """Undo what trial steps have left behind: gradients and counts, no weights."""
        self.objective.zero_grad(set_to_none=True)
        for part in parts_of(self.objective):
            part.reset_statistics()

    def all_finite(self) -> bool:
        """Tell whether the run is one to come back to: the last step was taken, and the weights are finite."""
        return self.guard.in_row == 0 and not self.broken_weights()

    def broken_weights(self) -> str | None:
        """Return the first module whose weights are not all finite; a finite loss may have had bad gradients."""
        return first_not_finite(self.objective.named_weights())

    @property
    def _key(self) -> int:
        return fold(self.seed, self.progress.attempt, self.progress.step)

    def _share(self, weight: Tensor) -> Share:
        """Return this process's part of the batch, given the sum of the weights of all of it."""
        num_rays, together = self.progress.batch_rays, self.objective.together
        return Share(ranks.share(num_rays // together).start * together, num_rays, weight)


def _norm_of_gradients(module: nn.Module) -> Float[Tensor, ""]:
    return get_total_norm([parameter.grad for parameter in module.parameters() if parameter.grad is not None])

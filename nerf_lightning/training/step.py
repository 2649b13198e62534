"""One step of training, which needs torch and no trainer: rays, tiles, gradients, update.

What a tile of rays needs stays in the cache, and the sum of the tiles' gradients is the whole batch's up to rounding.
"""

import logging
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from nerf_lightning.compute import ranks
from nerf_lightning.data.ray_batches import batch_size
from nerf_lightning.evaluation.metrics import RayErrors
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.corrections.base import Correction, NoCorrection
from nerf_lightning.nerf.encoders.base import tables_of
from nerf_lightning.nerf.kernels.render.workspace import forget_workspaces
from nerf_lightning.nerf.kernels.threads import threads_on, torch_on_one_thread
from nerf_lightning.nerf.losses.base import Loss
from nerf_lightning.nerf.losses.mse import squared_errors
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.subpixels import for_each_ray, mean_over_pixels, random_of_rays
from nerf_lightning.nerf.models.tiles import is_out_of_memory, tile_rays_for, tiles
from nerf_lightning.nerf.optimizers.schedule import Schedule
from nerf_lightning.nerf.part import Part, StepContext, parts_of
from nerf_lightning.nerf.randomness import batch_random, fold
from nerf_lightning.nerf.rendering.blending import background_colors, blend
from nerf_lightning.nerf.samplers.base import RaggedSampler
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.nerf.types.rays import Batch, Target
from nerf_lightning.nerf.types.renderings import Rendering
from nerf_lightning.nerf.types.scene import Background
from nerf_lightning.training.recorded_gradients import RecordedGradients, Recorder, cuda_graph
from nerf_lightning.training.step_guard import StepGuard, first_not_finite
from nerf_lightning.training.step_output import StepOutput
from nerf_lightning.training.tile_gradients import Backward, TileLoss, parallel_backward, sequential_backward

# The number of rays per step changes no more often.
BATCH_STEPS = 16
# Points of a tile where pictures are rendered beside steps that are not cut into tiles.
WHOLE_BATCH_POINTS = 65_536

log = logging.getLogger(__name__)


def _backward(loss: Tensor) -> None:
    loss.backward()


def _penalties(renderings: list[Rendering]) -> dict[str, Tensor]:
    """Return the penalties of levels as one more term of the loss; no term where no level has one."""
    if all(each.penalty is None for each in renderings):
        return {}
    means = [torch.zeros_like(each.depth[0]) if each.penalty is None else each.penalty.mean() for each in renderings]
    return {"penalty": torch.stack(means)}


KNOWN = (__name__.partition(".")[0], "torch")
"""Packages of whose modules it is known whether a recorded step follows them."""


@dataclass(frozen=True)
class Share:
    """A process's part of a step's batch."""

    first: int
    """Its first ray's slot in the batch."""
    num_rays: int
    """Rays of the whole batch."""
    weight: Tensor
    """Sum of the weights of the whole batch."""


class TrainStep:
    """Take steps of training, one after the other.

    Where a run has several processes, each has its share of the batch, and their gradients are added up once a step.

    Args:
        model: what learns.
        rays: makes the rays through a batch's pixels.
        loss: one number per level; their sum is minimized.
        optimizer: takes the parameters.
        schedule: factor on the learning rate as a function of the attempt's step.
        progress: the run's place; it is changed here, and read by the loader.
        seed: the run's seed.
        background: what lies behind the training rays.
        tile_points: most points that a tile may send through a field at once; None trains the batch whole.
        clip_norm: maximum norm of the gradient, to which larger ones are scaled down; None: no clipping.
        sample_budget: rays per step are chosen so that a step has about so many samples; None leaves them alone.
        start_weights: the model's state to start from; None draws weights, a function of (seed, attempt).
        num_steps: the length of the run, which the schedule follows; None: the trainer that runs it says so.
        correction: what photographs make of the rendered colors; None leaves them alone.
        jitter: False: samples lie in the middles of their intervals and one background is behind all rays, as at
            evaluation, so that steps differ in their pixels alone.

    Raises:
        InputError: a model that cannot be cut into tiles.
    """

    def __init__(
        self,
        model: Model,
        rays: RayGenerator,
        loss: Loss,
        optimizer: Callable[[Iterable[Any]], Optimizer],
        schedule: Schedule,
        progress: Progress,
        seed: int,
        background: Background,
        tile_points: int | None = None,
        clip_norm: int | float | None = None,
        sample_budget: int | None = None,
        start_weights: dict[str, Tensor] | None = None,
        num_steps: int | None = None,
        correction: Correction | None = None,
        jitter: bool = True,
    ):
        self.model, self.rays, self.loss = model, rays, loss
        self.correction = NoCorrection() if correction is None else correction
        self.build_optimizer, self.schedule = optimizer, schedule
        self.progress, self.num_steps, self.seed = progress, num_steps, seed
        self.background = background
        self.tile_points, self.clip_norm = tile_points, clip_norm
        self.sample_budget, self.jitter = sample_budget, jitter
        self.start_weights = start_weights
        self.guard = StepGuard()
        self._recorded: RecordedGradients | None = None
        model.set_returns_weights(loss.needs_weights)
        for part in model.modules():
            if isinstance(part, RaggedSampler) and sample_budget is not None:
                part.sample_budget = -(-sample_budget // ranks.world_size())
        if model.subpixels.side > 1 and loss.needs_weights:
            raise InputError(
                f"model.subpixels={model.subpixels.side} compares the mean of several rays with a photograph's pixel, "
                f"and the loss {type(loss).__name__} looks at the samples of single rays, as model=fast_proposal wants "
                "it. Leave model.subpixels out, or choose another loss or model."
            )
        self.draw_weights()

    def draw_weights(self) -> None:
        """Draw the weights of this attempt, or take those that it starts from."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(fold(self.seed, self.progress.attempt, "weights"))
            for part in self.parts.values():
                part.reset_parameters()
        if self.start_weights is not None:
            self.model.load_state_dict(self.start_weights)
        self.loss.forget()
        self.forget_recordings()

    def decided_on_host(self) -> str | None:
        """Return what decides on the host what a step computes, which a recording would not follow; None: nothing."""
        decides = ["refinement"] if list(self.rays.parameters()) else []
        decides += [] if self.correction.replays else ["correction"]
        penalized = [part for part in self._parts() if part.penalty() is not None]
        decides += ["a penalty"] if any(part is not self.correction for part in penalized) else []
        decides += ["loss"] if self.loss.buffers_to_average() else []
        decides += ["model.subpixels"] if self.model.subpixels.side > 1 else []
        decides += ["encoder.blend_in"] if any(getattr(each, "blend_in", 0) for each in self.model.modules()) else []
        return ", ".join(decides) or (None if self.model.replays else "model")

    @property
    def has_foreign_parts(self) -> bool:
        """Whether a class of somebody else's computes here, of which nobody knows what it decides on the host."""
        modules = (module for part in (*self.parts.values(), self.loss) for module in part.modules())
        return any(type(module).__module__.partition(".")[0] not in KNOWN for module in modules)

    def record_gradients(self, record: Recorder = cuda_graph) -> None:
        """Record the way forward and back of batches, whole, and replay it from now on.

        Raises:
            InputError: something here decides on the host what a step computes.
        """
        if (decides := self.decided_on_host()) is not None:
            raise InputError(
                "trainer.cuda_graph=true replays the same kernels in each step, and these may want others in another "
                f"step: {decides}. Leave it out."
            )

        def compute(batch: Batch, weight: Tensor, key: Tensor) -> StepOutput:
            share = self._share(weight)
            seen = self._in_tiles(batch, _backward, share, key, batch.num_rays)
            self._penalize(batch, _backward, share)
            if self._guards_in_recording:
                self.guard.keep_finite(seen.losses, self._named_parameters())
            return seen

        def counts() -> list[Tensor]:
            return [*self.model.sample_counts(), *self.guard.tensors(self.device)]

        self._recorded = RecordedGradients(compute, self._parameters(), counts, lambda: self.model.step_variant, record)

    def forget_recordings(self) -> None:
        """Free the memory of all recordings; a further step makes new ones, of where everything lies then."""
        if self._recorded is not None:
            self._recorded.recordings.clear()

    @property
    def records(self) -> bool:
        """Whether steps are recorded and replayed."""
        return self._recorded is not None

    @property
    def rays_together(self) -> int:
        """How many rays in a row of a batch no tile and no process may part: the pixels of a square."""
        return self.loss.patch**2

    @property
    def parts(self) -> dict[str, Any]:
        """All that learns, by the name under which a checkpoint keeps it; the model first."""
        return {"model": self.model, "rays": self.rays, "correction": self.correction}

    @property
    def device(self) -> torch.device:
        """Where the model is."""
        return next(self.model.parameters()).device

    def to(self, device: torch.device) -> "TrainStep":
        """Move all that is computed with to a device."""
        for part in self.parts.values():
            part.to(device)
        self.loss.to(device)
        return self

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

    def new_optimizer(self) -> Optimizer:
        """Return the optimizer of all that learns; the tables of encoders and what has its own rate do not decay.

        Raises:
            InputError: a setting of the optimizer that it refuses.
        """
        tables = tables_of(self.model)
        groups: list[dict[str, Any]] = [{"params": tables, "weight_decay": 0.0}] if tables else []
        known = set(map(id, tables))
        for part in self._parts():
            own = [parameter for parameter in part.parameters() if id(parameter) not in known]
            if own and part.learning_rate is not None:
                groups.append({"params": own, "weight_decay": 0.0, "lr": part.learning_rate})
                known |= set(map(id, own))
        groups.insert(0, {"params": [p for p in self._parameters() if id(p) not in known]})
        try:
            return self.build_optimizer(groups)
        except (ValueError, TypeError) as error:  # torch looks at its settings here
            raise InputError(
                f"The optimizer refuses its settings: {error}. Fix optimizer.*, or leave it out."
            ) from error

    def __call__(
        self, batch: Batch, optimizer: Any, backward: Backward = _backward, measure_gradients: bool = False
    ) -> StepOutput:
        """Take one step: gradients tile by tile, clipped, update.

        Args:
            batch: this process's share of the step's pixels.
            optimizer: torch's, or Lightning's wrapper of it.
            backward: adds a loss's gradients to the parameters'.
            measure_gradients: whether to measure the gradients' norms, before they are clipped.
        """
        with self._on_threads():
            return self._take(batch, optimizer, backward, measure_gradients)

    def _take(self, batch: Batch, optimizer: Any, backward: Backward, measure_gradients: bool) -> StepOutput:
        progress = self.progress
        optimizer.zero_grad()
        if self.num_steps is not None:
            context = StepContext(progress.step / self.num_steps, progress.step, self._key)
            for part in parts_of(*self.parts.values(), self.loss):
                part.on_step(context)
        self.model.update(progress.step, self._key)
        num_rays = progress.batch_rays
        share = self._share(ranks.total(batch.weight.sum()))
        seen = self.gradients_of_step(batch, backward, share)
        ranks.add_up([seen.losses, seen.color_errors, *seen.terms.values()])
        ranks.add_up_gradients(parameter for _, parameter in self._named_parameters())
        norms: dict[str, Tensor] = {}
        if self._guards_in_recording or self.guard.allows(seen.losses, self._named_parameters()):
            norms = self.model.gradient_norms() if measure_gradients else {}
            self._update(optimizer)
            self.loss.learn(seen.rgb, seen.target, seen.weight)
            ranks.average(self.loss.buffers_to_average())
        progress.advance(num_rays)
        if progress.step == 1 or progress.step % BATCH_STEPS == 0:
            ranks.average(self.model.buffers_to_average())
            if self.sample_budget is not None:
                points = self.model.points_per_ray(training=True)
                progress.batch_rays = batch_size(
                    progress.largest_batch, self.sample_budget / points, self.rays_together
                )
        return replace(seen, gradient_norms=norms)

    def gradients_of_step(self, batch: Batch, backward: Backward = _backward, share: Share | None = None) -> StepOutput:
        """Do what `gradients` does, by a replay where steps are recorded."""
        if self._recorded is None:
            return self.gradients(batch, backward, share)
        weight = batch.weight.sum() if share is None else share.weight
        try:
            return self._recorded(batch, weight, self._key)
        except RuntimeError as error:
            if not is_out_of_memory(error) and "captur" not in str(error):
                raise
            cause = "there is no memory" if is_out_of_memory(error) else f"CUDA refuses: {error}".splitlines()[0]
        log.warning("Steps are not recorded: %s. The kernels of each step are launched one by one.", cause)
        self._recorded = None
        for part in self.parts.values():
            part.zero_grad(set_to_none=False)
        return self.gradients(batch, backward, share)

    def gradients(self, batch: Batch, backward: Backward = _backward, share: Share | None = None) -> StepOutput:
        """Send a batch forward and backward, tile by tile; smaller tiles where there is no memory for these.

        Args:
            batch: pixels, colors, weights.
            backward: adds a loss's gradients to the parameters'.
            share: what part of the step's batch this is; None: all of it.

        Returns:
            What this share saw; its losses and errors add up over all shares to the batch's.
        """
        share = Share(0, batch.num_rays, batch.weight.sum()) if share is None else share
        with self._on_threads():
            return self._gradients(batch, backward, share)

    def _on_threads(self) -> AbstractContextManager[None]:
        # Whole batches are for torch's threads; tiles, and rays that kernels take whole, are shared out here.
        alone = self.tile_points is not None and self.device.type == "cpu"
        return torch_on_one_thread() if alone else nullcontext()

    def _gradients(self, batch: Batch, backward: Backward, share: Share) -> StepOutput:
        counts = [count.clone() for count in self.model.sample_counts()]
        while True:
            try:
                tile_rays = self._tile_rays(batch.num_rays, training=True)
                seen = self._in_tiles(batch, backward, share, self._key, tile_rays)
                break
            except RuntimeError as error:
                if not is_out_of_memory(error):
                    raise
                forget_workspaces()
                self._take_smaller_tiles(batch, error)
            for part in self.parts.values():
                part.zero_grad(set_to_none=False)
            for count, before in zip(self.model.sample_counts(), counts, strict=True):
                count.copy_(before)
        self._penalize(batch, backward, share)
        return seen

    def _penalize(self, batch: Batch, backward: Backward, share: Share) -> None:
        for part in self._parts():
            if (penalty := part.penalty()) is not None:
                backward(penalty * (batch.num_rays / share.num_rays))  # all shares add up to one penalty

    def validate(self, batch: Batch, errors: RayErrors) -> Tensor:
        """Collect and average the squared error of rays that no mask leaves out; backgrounds as at evaluation."""
        background = background_colors(self.background, batch.num_rays, batch.weight.device, None)
        target, several = blend(batch.rgba, background), self.model.subpixels
        rgb = torch.empty_like(target)
        for tile in tiles(batch.num_rays, self._tile_rays(batch.num_rays)):
            rays = self.rays.of_pixels(batch.pixels[tile], several)
            behind = None if background is None else for_each_ray(background[tile], several.per_pixel)
            rgb[tile] = mean_over_pixels(self.model(rays, behind, random=None)[-1], several.per_pixel).rgb
        errors.add(rgb, target, batch.weight)
        error = (rgb - target).square().mean(dim=-1)
        return (error * batch.weight).sum() / batch.weight.sum().clamp(min=1.0)

    def reset_statistics(self) -> None:
        """Undo what trial steps have left behind: gradients and counts, no weights."""
        for part in self.parts.values():
            part.zero_grad(set_to_none=True)
        self.model.reset_statistics()

    def all_finite(self) -> bool:
        """Tell whether the run is one to come back to: the last step was taken, and the weights are finite."""
        return self.guard.in_row == 0 and not self.broken_weights()

    def broken_weights(self) -> str | None:
        """Return the first module whose weights are not all finite; a finite loss may have had bad gradients."""
        return first_not_finite(self._named_parameters())

    @property
    def _guards_in_recording(self) -> bool:
        # Several processes add up their gradients first.
        return self._recorded is not None and ranks.world_size() == 1

    @property
    def _key(self) -> int:
        return fold(self.seed, self.progress.attempt, self.progress.step)

    def _share(self, weight: Tensor) -> Share:
        """Return this process's part of the batch, given the sum of the weights of all of it."""
        num_rays = self.progress.batch_rays
        first = ranks.share(num_rays // self.rays_together).start * self.rays_together
        return Share(first, num_rays, weight)

    def _parts(self) -> Iterator[Part]:
        """Return the parts of the model, then those beside it."""
        return parts_of(*self.parts.values())

    def _parameters(self) -> list[Parameter]:
        return [parameter for _, parameter in self._named_parameters()]

    def _named_parameters(self) -> Iterator[tuple[str, Parameter]]:
        for name, part in self.parts.items():
            yield from part.named_parameters(prefix="" if part is self.model else name)

    def _in_tiles(
        self, batch: Batch, backward: Backward, share: Share, key: int | Tensor, tile_rays: int
    ) -> StepOutput:
        num_rays, device = batch.num_rays, batch.weight.device
        random = batch_random(key, num_rays, device, share.first) if self.jitter else None
        behind = background_colors(self.background, num_rays, device, random, batch.rgba)
        # A mean of 1 over the batch, not over each tile. Without masks this is 1 exactly and changes no bit.
        weight = batch.weight * (share.num_rays / share.weight.clamp(min=1.0))
        target, several = Target(blend(batch.rgba, behind), weight, batch.pixels), self.model.subpixels
        if batch.distance is not None:
            distance, infinity = self.rays.distance_along(batch.pixels, batch.distance)
            target = replace(target, distance=distance, certainty=batch.certainty, infinity=infinity)

        def lose(tile: slice) -> TileLoss:
            # Made tile by tile, since the backward pass of a tile ends where cameras learn: in theirs.
            pixels = batch.pixels[tile]
            rays = self.rays.of_pixels(pixels, several)
            rays = replace(rays, photograph=for_each_ray(pixels.view, several.per_pixel))
            numbers = None if random is None else random_of_rays(random[tile], several.per_pixel)
            background = None if behind is None else for_each_ray(behind[tile], several.per_pixel)
            renderings = [mean_over_pixels(each, several.per_pixel) for each in self.model(rays, background, numbers)]
            shown = [self.correction.photographed(each, pixels) for each in renderings]
            terms = self.loss(shown, target[tile]) | _penalties(renderings)
            levels = torch.stack(list(terms.values())).sum(dim=0) if len(terms) > 1 else next(iter(terms.values()))
            part = (tile.stop - tile.start) / share.num_rays
            with torch.no_grad():
                errors = squared_errors(shown, target[tile])
            terms = {name: values.detach() for name, values in terms.items()}
            if part < 1.0:
                levels, errors = levels * part, errors * part
                terms = {name: values * part for name, values in terms.items()}
            return TileLoss(levels, terms, errors, renderings[-1].foreground, shown[-1].rgb)

        together = self.rays_together
        threads = 1 if self.tile_points is None else threads_on(device)
        if threads > 1 and not self.model.takes_whole_rays(
            device, training=True, learns_cameras=self.rays.refinement.moves()
        ):
            parts = list(tiles(num_rays, tile_rays, together, multiple=threads))
            lost = parallel_backward(lose, parts, backward, self._parameters())
        else:
            lost = sequential_backward(lose, list(tiles(num_rays, threads * tile_rays, together)), backward)
        of_batch = TileLoss.joined(lost)
        return StepOutput(
            losses=of_batch.levels,
            terms=of_batch.terms,
            color_errors=of_batch.errors,
            foreground=of_batch.foreground,
            rgb=of_batch.rgb,
            target=target.rgb,
            weight=batch.weight,
            pixels=batch.pixels,
        )

    def _take_smaller_tiles(self, batch: Batch, error: RuntimeError) -> None:
        if self.tile_points is None or self._tile_rays(batch.num_rays, training=True) <= self.rays_together:
            raise InputError(
                f"There is no memory for a training step: {error}. Use fewer rays (data.batch_rays), a smaller model, "
                "or tiles (trainer.tile_points=auto)."
            ) from error
        points = batch.num_rays * self.model.points_per_ray(training=True)
        self.tile_points = int(min(self.tile_points, points)) // 2
        log.warning("out of memory: reducing tiles to %d points and repeating the step", self.tile_points)

    def _tile_rays(self, num_rays: int, training: bool = False) -> int:
        """Return how many of so many pixels are rendered at once."""
        if self.tile_points is None:
            return num_rays
        return max(1, tile_rays_for(self.model, self.tile_points, training) // self.model.subpixels.per_pixel)

    def _update(self, optimizer: Any) -> None:
        if self.clip_norm is not None:
            torch.nn.utils.clip_grad_norm_(self._parameters(), self.clip_norm)
        if self.num_steps is None:
            raise InputError("The length of the run is not known, which the learning rate follows: give num_steps=....")
        factor = self.schedule(self.progress.step, self.num_steps)
        for group in optimizer.param_groups:
            group["lr"] = factor * group.setdefault("base_lr", group["lr"])
        optimizer.step()

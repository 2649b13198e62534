"""The one LightningModule: it wires model, loss, optimizer and schedule together, and holds no mathematics."""

import logging
import os
from collections.abc import Callable, Iterable
from dataclasses import asdict
from typing import Any

import torch
from lightning.pytorch import LightningModule
from torch import Tensor
from torch.optim import Optimizer

from nerf_lightning import ranks
from nerf_lightning.checkpoints.format import KEY, LOOPS, record
from nerf_lightning.checkpoints.resume_state import require_callbacks, require_loops, require_resumable
from nerf_lightning.data.ray_batches import batch_size
from nerf_lightning.errors import InputError
from nerf_lightning.evaluation.metrics import RayErrors
from nerf_lightning.nerf.encoders.base import tables_of
from nerf_lightning.nerf.losses.base import Loss
from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.models.tiles import is_out_of_memory, tile_rays_for, tiles
from nerf_lightning.nerf.optimizers.schedule import Schedule
from nerf_lightning.nerf.randomness import batch_random, fold
from nerf_lightning.nerf.rendering.blending import background_colors, blend
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.nerf.types.rays import Batch
from nerf_lightning.nerf.types.scene import Background
from nerf_lightning.training.step import Share, add_gradients
from nerf_lightning.training.step_guard import StepGuard, first_not_finite

# The number of rays per step changes no more often.
BATCH_STEPS = 16

log = logging.getLogger(__name__)


class RadianceFieldSystem(LightningModule):
    """Train a radiance model on ray batches.

    A step is cut into tiles of rays whose gradients add up: the activations stay in the cache, and the result is the
    whole step's up to rounding. Hence the optimisation is manual. Where a run has several processes, each has its share
    of the batch, and their gradients are added up once a step.

    Args:
        model: the levels.
        loss: one number per level; their sum is minimised.
        optimizer: takes the parameters.
        schedule: factor on the learning rate as a function of the attempt's step.
        progress: the run's place, shared with the loader.
        num_steps: the length of the run.
        seed: the run's seed.
        background: what lies behind the training rays.
        tile_points: most points that a tile may send through a field at once; None trains the batch whole.
        clip_norm: gradients are scaled down to this norm; None leaves them.
        sample_budget: rays per step are chosen so that a step has about so many samples; None leaves them alone.
        record: what a checkpoint needs to be used alone (config text, cameras, bounds).
    """

    def __init__(
        self,
        model: RadianceModel,
        loss: Loss,
        optimizer: Callable[[Iterable[Any]], Optimizer],
        schedule: Schedule,
        progress: Progress,
        num_steps: int,
        seed: int,
        background: Background,
        tile_points: int | None,
        clip_norm: int | float | None,
        sample_budget: int | None,
        record: dict[str, Any],
    ):
        super().__init__()
        self.automatic_optimization = False
        self.model, self.loss = model, loss
        self.build_optimizer, self.schedule = optimizer, schedule
        self.progress, self.num_steps, self.seed = progress, num_steps, seed
        self.background = background
        self.tile_points, self.clip_norm = tile_points, clip_norm
        self.sample_budget = sample_budget
        self.record = record
        self.start_weights: dict[str, Tensor] | None = None
        if tile_points is not None and model.needs_whole_batch:
            raise InputError(
                "field.batch_norm=true normalises over the whole batch, so the step cannot be cut into tiles: "
                "add trainer.tile_points=null, or leave batch_norm off."
            )
        self.guard = StepGuard()
        self.last_step: dict[str, Tensor] = {}
        # Who wants to know the gradients' norms before they are clipped asks for them, and finds them here.
        self.measures_gradients = False
        self.gradient_norms: dict[str, Tensor] = {}
        self.val_errors = RayErrors()

    def initialize(self) -> None:
        """Draw the weights of this attempt, a function of (seed, attempt), or take those it starts from."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(fold(self.seed, self.progress.attempt, "weights"))
            self.model.reset_parameters()
        if self.start_weights is not None:
            self.model.load_state_dict(self.start_weights)

    def restart(self) -> None:
        """Begin a new attempt with fresh weights, optimizer and order of rays."""
        self.progress.restart()
        self.initialize()
        optimizer = self.optimizers().optimizer  # type: ignore[union-attr]
        optimizer.state.clear()

    def configure_optimizers(self) -> Optimizer:
        """Complete the optimizer; the parameters of encoders are tables, which do not decay.

        Raises:
            InputError: a setting of the optimizer that it refuses.
        """
        tables = tables_of(self.model)
        known = set(map(id, tables))
        groups: list[dict[str, Any]] = [{"params": [p for p in self.model.parameters() if id(p) not in known]}]
        if tables:
            groups.append({"params": tables, "weight_decay": 0.0})
        try:
            return self.build_optimizer(groups)
        except (ValueError, TypeError) as error:  # torch looks at its settings here
            raise InputError(
                f"The optimizer refuses its settings: {error}. Mend optimizer.*, or leave it out."
            ) from error

    def training_step(self, batch: Batch, batch_index: int) -> None:
        """Take one step: tiles forward and backward, clip, update."""
        optimizer, progress = self.optimizers(), self.progress
        optimizer.zero_grad()  # type: ignore[union-attr]
        self.model.update(progress.step, fold(self.seed, progress.attempt, progress.step))
        num_rays = progress.batch_rays
        share = Share(ranks.share(num_rays).start, num_rays, ranks.total(batch.weight.sum()))
        self.last_step = self.accumulate_gradients(batch, self.manual_backward, share)
        ranks.add_up([self.last_step["losses"]])
        ranks.add_up_gradients(self.model.parameters())
        if self.guard.allows(self.last_step["losses"], self.model.named_parameters()):
            self._update(optimizer)
        progress.advance(num_rays)
        if progress.step == 1 or progress.step % BATCH_STEPS == 0:
            ranks.average(self.model.measurements())
        if self.sample_budget is not None and (progress.step == 1 or progress.step % BATCH_STEPS == 0):
            points = self.model.points_per_ray(training=True)
            progress.batch_rays = batch_size(progress.largest_batch, self.sample_budget / points)

    def accumulate_gradients(
        self, batch: Batch, backward: Callable[[Tensor], None], share: Share | None = None
    ) -> dict[str, Tensor]:
        """Send a batch forward and backward, tile by tile; smaller tiles where there is no memory for these.

        Args:
            batch: rays, colours, weights.
            backward: adds a loss's gradients to the parameters'.
            share: what part of the step's batch this is; None: all of it.

        Returns:
            `losses` per level, and each ray's `foreground` light, `target` colour and `weight`, detached. The losses of
            all shares add up to the batch's.
        """
        share = Share(0, batch.rays.near.numel(), batch.weight.sum()) if share is None else share
        counts = [count.clone() for count in self.model.counts()]
        while True:
            try:
                return self._accumulate(batch, backward, share)
            except RuntimeError as error:
                if not is_out_of_memory(error):
                    raise
                self._take_smaller_tiles(batch, error)
            self.model.zero_grad(set_to_none=False)
            for count, before in zip(self.model.counts(), counts, strict=True):
                count.copy_(before)

    def _accumulate(self, batch: Batch, backward: Callable[[Tensor], None], share: Share) -> dict[str, Tensor]:
        num_rays = batch.rays.near.numel()
        key = fold(self.seed, self.progress.attempt, self.progress.step)
        random = batch_random(key, num_rays, self.device, share.first)
        tile_rays = self._tile_rays(num_rays, training=True)
        return add_gradients(self.model, self.loss, backward, batch, share, random, self.background, tile_rays)

    def _take_smaller_tiles(self, batch: Batch, error: RuntimeError) -> None:
        if self.tile_points is None or self._tile_rays(batch.rays.near.numel(), training=True) == 1:
            raise InputError(
                f"There is no memory for a training step: {error}. Use fewer rays (data.batch_rays), a smaller model, "
                "or tiles (trainer.tile_points=auto)."
            ) from error
        points = batch.rays.near.numel() * self.model.points_per_ray(training=True)
        self.tile_points = int(min(self.tile_points, points)) // 2
        log.warning(
            "no memory for so large a tile: from now on tiles of %d points; the step is repeated", self.tile_points
        )

    def learn_points_per_ray(self) -> None:
        """Take over how many samples the rays rendered so far have had, where a level measures it."""
        self.model.update(0, 0)

    def forget_measurements(self) -> None:
        """Undo what trial steps have left behind: gradients and counts, no weights."""
        self.model.zero_grad(set_to_none=True)
        self.model.forget_measurements()

    def is_sound(self) -> bool:
        """Tell whether the run is one to come back to: the last step was taken, and the weights are finite."""
        return self.guard.in_row == 0 and not self.broken_weights()

    def broken_weights(self) -> str | None:
        """Return the first module whose weights are not all finite; a finite loss may have had bad gradients."""
        return first_not_finite(self.model)

    def _require_finite_weights(self) -> None:
        if self.broken_weights():
            raise InputError(
                f"The weights of step {self.trainer.global_step} are not finite numbers, so they are not saved. The "
                f"last good checkpoint, where one was saved, is {self.trainer.default_root_dir}/checkpoints/last.ckpt. "
                "Go on from it with a smaller optimizer.lr, or add gradient clipping (trainer.clip_norm=1)."
            )

    def validation_step(self, batch: Batch, batch_index: int) -> None:
        """Collect the squared error of fixed rays that no mask leaves out; backgrounds as at evaluation."""
        background = background_colors(self.background, batch.rays.near.numel(), self.device, None)
        target = blend(batch.rgba, background)
        for tile in tiles(target.shape[0], self._tile_rays(target.shape[0])):
            behind = None if background is None else background[tile]
            rendering = self.model(batch.rays[tile], behind, random=None)[-1]
            self.val_errors.add(rendering.rgb, target[tile], batch.weight[tile])

    def on_validation_epoch_end(self) -> None:
        """Log the PSNR of the fixed rays; straight to the loggers, since Lightning would count the step before."""
        values = self.val_errors.summary()
        self.log("val/psnr", values["val/psnr"], logger=False, sync_dist=True)
        for logger in self.trainer.loggers:
            logger.log_metrics(values, self.trainer.global_step)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add what makes the file self-contained, and the run's state beyond weights and optimizer.

        Raises:
            InputError: the weights are not finite.
            Unfit: what would be written is not what is read, which is a mistake of this program.
        """
        self._require_finite_weights()
        checkpoint[KEY] = self.record | {
            "progress": asdict(self.progress),
            "bad_steps": self.guard.state(),
            "tile_points": self.tile_points,
            "num_threads": torch.get_num_threads(),
            "world_size": ranks.world_size(),
        }
        record(resumable=True).require(checkpoint[KEY], KEY, {})

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take up the state again: place and thread count decide the last bits of every sum.

        So does the tile, which whoever builds the system chooses (`TrainerSettings.keep_tile`).

        Raises:
            InputError: the checkpoint is not one of this run; nothing was taken from it.
        """
        self._require_own(checkpoint)
        state = checkpoint[KEY]
        self.progress.take_up(Progress(**state["progress"]))
        self.guard.restore(state["bad_steps"], self.device)
        if state["world_size"] == ranks.world_size():
            _use_threads(state["num_threads"])

    def _require_own(self, checkpoint: dict[str, Any]) -> None:
        trainer = self.trainer
        require_resumable(checkpoint, self.model, self.build_optimizer, self.progress, self.configure_optimizers())
        require_callbacks(checkpoint["callbacks"], trainer.callbacks)  # type: ignore[attr-defined]
        ours = {key: getattr(trainer, key).state_dict() for key in LOOPS}
        skipped = checkpoint[KEY]["bad_steps"][0]
        require_loops(checkpoint["loops"], ours, checkpoint["global_step"], skipped)

    def _tile_rays(self, num_rays: int, training: bool = False) -> int:
        return num_rays if self.tile_points is None else tile_rays_for(self.model, self.tile_points, training)

    def _update(self, optimizer: Any) -> None:
        self.gradient_norms = self.model.gradient_norms() if self.measures_gradients else {}
        if self.clip_norm is not None:
            torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.clip_norm)
        for group in optimizer.param_groups:
            group["lr"] = self.schedule(self.progress.step, self.num_steps) * group.setdefault("base_lr", group["lr"])
        optimizer.step()


def _use_threads(number: int) -> None:
    cores = os.cpu_count() or 1
    if number <= cores:
        torch.set_num_threads(number)
    else:
        log.warning(
            "The run has used %d threads and this machine has %d cores: it goes on with %d, and may differ in the last "
            "bits.",
            number,
            cores,
            torch.get_num_threads(),
        )

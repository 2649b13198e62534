"""The only LightningModule: it passes a trainer's batches to the step, and the run's state to checkpoints."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule
from lightning.pytorch.trainer.states import TrainerFn
from torch import Tensor
from torch.optim import Optimizer

from nerf_lightning.checkpoints.format import KEY, LAST, LOOPS
from nerf_lightning.checkpoints.reading import read_checkpoint, read_content
from nerf_lightning.checkpoints.same_capture import require_same_capture
from nerf_lightning.evaluation.metrics import image_metrics
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.models.render_image import Picture, render_picture
from nerf_lightning.nerf.psnr import psnr
from nerf_lightning.nerf.rendering.background import background_colors, blend
from nerf_lightning.nerf.types.rays import Batch
from nerf_lightning.training.callbacks.monitor import Monitor
from nerf_lightning.training.callbacks.progress_bar import TrainingProgress
from nerf_lightning.training.launch.checkpoint_io import AtomicCheckpointIO
from nerf_lightning.training.launch.fitting import length_of_run, require_fitting
from nerf_lightning.training.rendering_step import rendering_step
from nerf_lightning.training.restore import require_resumable, restore_run, run_state
from nerf_lightning.training.step import TrainStep
from nerf_lightning.training.step_guard import first_not_finite
from nerf_lightning.training.validation import RayErrors


class RadianceFieldSystem(LightningModule):
    """Train a radiance field on ray batches with Lightning.

    A step cuts its batch into tiles whose gradients add up, hence the manual optimization. Callbacks get a step's
    output (`StepOutput`) as `outputs["step"]` of `on_train_batch_end`.

    Args:
        train_step: takes the steps.
        record: what makes a checkpoint self-contained (config text, cameras, bounds).
        resume_changed_capture: resume from a checkpoint even if its capture has changed, with a warning.
    """

    def __init__(self, train_step: TrainStep, record: dict[str, Any], resume_changed_capture: bool = False):
        super().__init__()
        self.automatic_optimization = False
        self.train_step, self.record, self.resume_changed_capture = train_step, record, resume_changed_capture
        # The step's modules are registered here, so that they move to the trainer's device and are saved.
        objective = train_step.objective
        self.model, self.rays = objective.model, objective.rays
        self.correction, self.loss = objective.correction, objective.loss
        self.val_errors = RayErrors()

    @classmethod
    def load_from_checkpoint(  # type: ignore[override]
        cls, checkpoint_path: Any, map_location: Any = None, trust: Sequence[str] = ()
    ) -> Any:
        """Return a system that renders and validates, from an untrusted file; it cannot train.

        Args:
            checkpoint_path: the file.
            map_location: the device.
            trust: modules of your own, such as ["my_parts"], whose model parts may be built.

        Raises:
            InputError: it cannot be read, or names something that is not a part of this program's models.
        """
        checkpoint = read_checkpoint(checkpoint_path)
        return cls(rendering_step(checkpoint, trust), checkpoint.record).to(map_location or "cpu").eval()

    def configure_callbacks(self) -> list[Any]:
        """Return none; Lightning calls this before it checks its own settings, so impossible ones are refused here.

        Raises:
            InputError: the trainer cannot fit this system.
        """
        if self.trainer.state.fn == TrainerFn.FITTING:
            require_fitting(self.trainer)
        return []

    def configure_optimizers(self) -> Optimizer:
        """Return the step's optimizer.

        Raises:
            InputError: the optimizer refuses a setting.
        """
        return self.train_step.new_optimizer()

    def on_fit_start(self) -> None:
        """Take the length of the run from the trainer, and record its steps if requested and possible.

        Raises:
            InputError: the run has no length, or its steps cannot be recorded.
        """
        self.train_step.num_steps = length_of_run(self.trainer, self.train_step.progress)
        self.train_step.begin_recording()

    def on_fit_end(self) -> None:
        """Discard recordings, so that copies and pickles of the system do not contain them."""
        self.train_step.gradients = self.train_step.tiles

    def training_step(self, batch: Batch, batch_index: int) -> Mapping[str, Any]:
        """Take one step, and return the sum of the levels' losses as `loss`, and its output (`StepOutput`) as `step`.

        Logs `train/loss` and `train/psnr` (dB, of the step's rays) unless a callback of `nerf train` does.
        """
        callbacks: list[Callback] = self.trainer.callbacks  # type: ignore[attr-defined]
        watched = any(isinstance(each, Monitor) and each.wants_gradients(self.trainer, self) for each in callbacks)
        seen = self.train_step(batch, self.optimizers(), self.manual_backward, measure_gradients=watched)
        loss = seen.losses.sum()
        if not any(isinstance(each, Monitor | TrainingProgress) for each in callbacks):
            # Values on a bar are read in each step, which waits for the device.
            on_bar = self.trainer.progress_bar_callback is not None
            self.log_dict({"train/loss": loss, "train/psnr": psnr(seen.color_errors[-1])}, prog_bar=on_bar)
        return {"loss": loss, "step": seen}

    def validation_step(self, batch: Batch, batch_index: int) -> dict[str, Tensor]:
        """Collect the squared error of fixed rays; return its mean over the batch as `loss`, and the `psnr` (dB)."""
        loss = self.val_errors.of(self.train_step.objective, batch, self.train_step.tiles.points)
        return {"loss": loss, "psnr": psnr(loss)}

    def on_validation_epoch_end(self) -> None:
        """Log loss and PSNR (dB) of the fixed rays.

        While fitting they go directly to the loggers, since Lightning would log the step before.
        """
        values, fits = self.val_errors.summary(), self.trainer.state.fn == TrainerFn.FITTING
        shown = {"val/psnr": values["val/psnr"], "val/loss": 10.0 ** (-values["val/psnr"] / 10.0)}
        self.log_dict(shown, prog_bar=True, logger=False if fits else None, sync_dist=True)
        for logger in self.trainer.loggers if fits and not self.trainer.sanity_checking else []:
            logger.log_metrics(values, self.trainer.global_step)

    def test_step(self, batch: Batch, batch_index: int) -> dict[str, float]:
        """Compare a whole view with its photograph, and return and log `psnr`, `cc_psnr` (dB) and `ssim`.

        The means over the views, such as `test/psnr`, are those of `nerf eval`, which evaluates more: geometry, LPIPS
        and, if cameras were learned, how those of the test views have to move.

        Raises:
            InputError: the batch is not a whole view.
        """
        picture = self.predict_step(batch, batch_index)
        behind = background_colors(self.train_step.objective.background, 1, torch.device("cpu"), random=None)
        kept = batch.weight.cpu() > 0
        values = image_metrics(picture.rgb, blend(batch.rgba.cpu(), behind), None if bool(kept.all()) else kept)
        known = {name: value for name, value in values.items() if value is not None}
        self.log_dict({f"test/{name}": value for name, value in known.items()}, batch_size=1, sync_dist=True)
        return known

    def predict_step(self, batch: Batch, batch_index: int) -> Picture:
        """Render a whole view: color, depth in scene units, opacity.

        Raises:
            InputError: the batch is not a whole view.
        """
        if batch.weight.dim() != 2:
            raise InputError(
                "Tests and predictions are of whole views, and these are single rays: give Trainer.test and "
                "Trainer.predict datamodule=run.data, or its test_dataloader()."
            )
        view = int(batch.pixels.view[0, 0])
        background, tile_points = self.train_step.objective.background, self.train_step.tiles.picture_points
        return render_picture(self.model, self.rays, view, background, tile_points)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add what makes the file self-contained, and the run's state besides weights and optimizer.

        Raises:
            InputError: the weights are not finite.
        """
        if first_not_finite(self.train_step.objective.named_weights()):
            raise InputError(
                f"The weights of step {self.trainer.global_step} are not finite numbers, so they are not saved. The "
                f"last good checkpoint, where one was saved, is {self.trainer.default_root_dir}/checkpoints/last.ckpt. "
                "Go on from it with a smaller optimizer.lr, or add gradient clipping (trainer.clip_norm=1)."
            )
        checkpoint[KEY] = self.kept_record()

    def kept_record(self) -> dict[str, Any]:
        """Return what makes a checkpoint self-contained, and the run's state besides weights and optimizer."""
        refined = self.rays.refined(self.record["scene"]["splits"]["train"])
        return self.record | run_state(self.train_step) | ({} if refined is None else {"refined": dict(vars(refined))})

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Check what Lightning is about to restore, and restore the rest of the run.

        Raises:
            InputError: the checkpoint does not belong to this run or its capture; nothing was restored from it.
        """
        trainer, train_step, path = self.trainer, self.train_step, Path(self.trainer.ckpt_path or LAST)
        if not isinstance(trainer.strategy.checkpoint_io, AtomicCheckpointIO):  # Lightning's own checks nothing
            content = read_content(path)
            checkpoint.clear()
            checkpoint.update(content)
        state = checkpoint[KEY]
        if trainer.state.fn == TrainerFn.FITTING:  # a model may be tested on any capture
            require_same_capture(state, self.record, self.resume_changed_capture)
        require_resumable(
            checkpoint,
            path,
            weights=self.state_dict(),
            optimizer=self.configure_optimizers(),
            build=train_step.build_optimizer,
            callbacks=trainer.callbacks,  # type: ignore[attr-defined]
            loops={key: getattr(trainer, key).state_dict() for key in LOOPS},
            progress=train_step.progress,
            multiple_of=train_step.objective.pixels_per_patch,
        )
        restore_run(state, train_step, self.device)

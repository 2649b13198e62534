"""Scalars for TensorBoard: losses, PSNR and gradients of each level, learning rate, speed, memory.

How often: `conf/callbacks/default.yaml`. Names of curves: `training/loggers.py`.
"""

import time
from typing import Any

import psutil
import torch
from lightning.pytorch import Trainer
from torch import Tensor

from nerf_lightning.nerf.objective import StepOutput
from nerf_lightning.nerf.part import statistics
from nerf_lightning.nerf.psnr import psnr
from nerf_lightning.training.callbacks.watcher import Watcher

GIGABYTE = 1e9


class Monitor(Watcher):
    """Log losses, PSNR (dB), speed, memory (gigabytes) and gradients every few steps.

    They go directly to the loggers: `LightningModule.log` would cost more than a small step.

    Args:
        every_steps: steps between two points of the curves.
    """

    def __init__(self, every_steps: int = 50):
        super().__init__(every_steps)
        self.since = 0.0
        self.rays_seen = 0

    def is_time(self, step: int, last_step: int) -> bool:
        """See `Watcher`; a run too short for two rows gets about ten."""
        is_short = last_step < 2 * self.every_steps
        return step % max(last_step // 10, 1) == 0 if is_short else super().is_time(step, last_step)

    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        """Start the clock."""
        self.since = time.perf_counter()
        self.rays_seen = pl_module.train_step.progress.rays_seen

    def leave_out(self, seconds: float) -> None:
        """Do not count the last `seconds`: training was paused."""
        self.since += seconds

    def wants_gradients(self, trainer: Trainer, system: Any) -> bool:
        """Return whether the next step gets a row, and so has to measure the norms of its gradients."""
        # XLA would compile steps with and without a row as two programs.
        return system.device.type == "xla" or self.is_time(
            trainer.global_step + 1, int(trainer.estimated_stepping_batches)
        )

    def watch(self, trainer: Any, system: Any, outputs: Any) -> None:
        """Log a row."""
        progress = system.train_step.progress
        now, step = time.perf_counter(), trainer.global_step
        rays, seconds = progress.rays_seen - self.rays_seen, now - self.since
        self.since, self.rays_seen = now, progress.rays_seen
        names = system.model.level_names
        first = system.model.first_picture
        pictures = names[-1:] if first is None else names[first:]
        output: StepOutput = outputs["step"]
        values = level_scalars(names, output.losses, output.color_errors, pictures)
        if len(output.terms) > 1:
            values |= {f"train/loss_{name}": float(term.sum()) for name, term in output.terms.items()}
        values |= statistics(system.model)
        values["train/learning_rate"] = system.optimizers().param_groups[0]["lr"]
        if rays > 0 and seconds > 0:
            values["speed/rays_per_second"] = rays / seconds
        values["speed/rays_per_step"] = output.weight.numel()
        values["train/skipped_steps"] = system.train_step.guard.skipped
        values["memory/resident_gigabytes"] = psutil.Process().memory_info().rss / GIGABYTE
        if system.device.type == "cuda":
            values["memory/gpu_peak_gigabytes"] = torch.cuda.max_memory_allocated() / GIGABYTE
        values |= {f"gradients/norm_{name}": float(norm) for name, norm in output.gradient_norms.items()}
        for logger in trainer.loggers:
            logger.log_metrics(values, step)


def level_scalars(
    names: tuple[str, ...], losses: Tensor, errors: Tensor, pictures: tuple[str, ...]
) -> dict[str, float]:
    """Return the scalars to log for a step's levels.

    Args:
        names: names of the levels.
        losses: loss of each, of any kind.
        errors: mean squared error of each level's colors.
        pictures: names of the levels that render pictures, whose PSNR is logged.
    """
    losses, shown = torch.stack([losses, psnr(errors)]).cpu()  # the device is read once
    values = {"train/loss": float(losses.sum())}
    for name, loss, quality in zip(names, losses, shown, strict=True):
        if len(names) > 1:  # else it equals the sum
            values[f"train/loss_{name}"] = float(loss)
        if name in pictures:
            values[f"train/psnr_{name}"] = float(quality)
    return values

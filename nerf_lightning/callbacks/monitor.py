"""Scalars for TensorBoard: losses, PSNR of each level, learning rate, speed, memory."""

import time
from typing import Any

import psutil
import torch
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from nerf_lightning.errors import require_positive

GIGABYTE = 1e9


class Monitor(Callback):
    """Log every few steps, straight to the loggers: `LightningModule.log` would cost more than a small step.

    Args:
        every_steps: steps between two rows.
    """

    def __init__(self, every_steps: int = 50):
        require_positive(every_steps=every_steps)
        self.every_steps = every_steps
        self.since = 0.0
        self.rays_seen = 0

    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        """Start the clock."""
        self.since = time.perf_counter()
        self.rays_seen = pl_module.progress.rays_seen

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Log a row when it is time."""
        if trainer.global_step % self.every_steps:
            return
        now, step = time.perf_counter(), trainer.global_step
        rays, seconds = pl_module.progress.rays_seen - self.rays_seen, now - self.since
        self.since, self.rays_seen = now, pl_module.progress.rays_seen
        names = pl_module.model.level_names
        pictures = names if pl_module.loss.every_level_is_a_picture else names[-1:]
        values = level_scalars(names, pl_module.last_step["losses"], pictures) | pl_module.model.statistics()
        values["train/learning_rate"] = pl_module.optimizers().param_groups[0]["lr"]
        if rays > 0 and seconds > 0:
            values["speed/rays_per_second"] = rays / seconds
        values["speed/rays_per_step"] = batch.rays.near.numel()
        values["train/skipped_steps"] = pl_module.guard.skipped
        values["memory/resident_gigabytes"] = psutil.Process().memory_info().rss / GIGABYTE
        if pl_module.device.type == "cuda":
            values["memory/gpu_peak_gigabytes"] = torch.cuda.max_memory_allocated() / GIGABYTE
        for logger in trainer.loggers:
            logger.log_metrics(values, step)


def level_scalars(names: tuple[str, ...], losses: Tensor, pictures: tuple[str, ...]) -> dict[str, float]:
    """Return the loss of each level, the PSNR of those whose loss is of a picture, and the sum that is minimised."""
    losses = losses.cpu()  # the device is read once
    values = {"train/loss": float(losses.sum())}
    for name, loss in zip(names, losses, strict=True):
        values[f"train/loss_{name}"] = float(loss)
        if name in pictures:
            values[f"train/psnr_{name}"] = float(-10.0 * torch.log10(loss))
    return values

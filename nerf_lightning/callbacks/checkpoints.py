"""When checkpoints are written: `last.ckpt` every so often and at the end, `best.ckpt` at the best validation."""

from pathlib import Path
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from nerf_lightning.errors import require_positive


class Checkpoints(Callback):
    """Keep the last and the best.

    Args:
        every_steps: steps between two writes of `last.ckpt`.
        monitor: the logged value whose maximum is the best.
    """

    def __init__(self, every_steps: int = 500, monitor: str = "val/psnr"):
        require_positive(every_steps=every_steps)
        self.every_steps, self.monitor = every_steps, monitor
        self.best: float | None = None

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Write `last.ckpt` when it is time."""
        if trainer.global_step % self.every_steps == 0:
            trainer.save_checkpoint(self.folder(trainer) / "last.ckpt")

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write `best.ckpt` when the validation was the best so far."""
        value = trainer.callback_metrics.get(self.monitor)
        if trainer.sanity_checking or value is None:
            return
        if self.best is None or float(value) > self.best:
            self.best = float(value)
            trainer.save_checkpoint(self.folder(trainer) / "best.ckpt")

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write `last.ckpt` at the end."""
        trainer.save_checkpoint(self.folder(trainer) / "last.ckpt")

    def state_dict(self) -> dict[str, Any]:
        """Remember the best across a resume."""
        return {"best": self.best}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take the best up again."""
        self.best = state_dict["best"]

    @staticmethod
    def folder(trainer: Trainer) -> Path:
        """Return where the run's checkpoints lie."""
        return Path(trainer.default_root_dir) / "checkpoints"

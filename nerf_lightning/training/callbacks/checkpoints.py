"""When checkpoints are written: `last.ckpt` regularly and at the end, `best.ckpt` at the best validation.

The preceding `last.ckpt` is kept as `previous.ckpt` (`checkpoints/writing.py` rotates them).

The files' names: `checkpoints/format.py`. How often, and what is best (`monitor`): `conf/callbacks/default.yaml`.
"""

from pathlib import Path
from typing import Any, ClassVar

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback

from nerf_lightning.checkpoints.format import BEST, LAST
from nerf_lightning.files.atomic import remove_leftovers
from nerf_lightning.messages.errors import InputError, require_positive
from nerf_lightning.training.launch.checkpoint_io import AtomicCheckpointIO
from nerf_lightning.training.step import TrainStep
from nerf_lightning.training.step_guard import first_not_finite


class Checkpoints(Callback):
    """Keep the last checkpoint, the one before, and the best.

    While gradients or weights are not finite nothing is saved, so that the last one is good to return to (`NanGuard`).

    Args:
        every_steps: steps between checkpoints (`last.ckpt`).
        monitor: the logged value whose maximum is the best.
    """

    STATE: ClassVar = {"best": float | None}
    needs_state = True

    def __init__(self, every_steps: int = 500, monitor: str = "val/psnr"):
        require_positive(every_steps=every_steps)
        self.every_steps, self.monitor = every_steps, monitor
        self.best: float | None = None

    def setup(self, trainer: Trainer, pl_module: Any, stage: str) -> None:
        """Check that the trainer has our writer, and remove partial files left by killed processes.

        Raises:
            InputError: it does not.
        """
        writer(trainer, self)
        if self.folder(trainer).is_dir():  # a run that ends without another step would leave them
            remove_leftovers(self.folder(trainer))

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Write `last.ckpt` when it is time.

        Raises:
            InputError: an earlier one could not be written.
        """
        writer(trainer, self).raise_failure()
        if trainer.global_step % self.every_steps == 0 and _is_finite(pl_module.train_step):
            trainer.save_checkpoint(self.folder(trainer) / LAST)

    def on_validation_end(self, trainer: Trainer, pl_module: Any) -> None:
        """Write `best.ckpt` when the validation was the best so far."""
        value = trainer.callback_metrics.get(self.monitor)
        if trainer.sanity_checking or value is None:
            return
        if (self.best is None or float(value) > self.best) and _is_finite(pl_module.train_step):
            self.best = float(value)
            trainer.save_checkpoint(self.folder(trainer) / BEST)

    def on_train_end(self, trainer: Trainer, pl_module: Any) -> None:
        """Write `last.ckpt` at the end, and wait until everything is on disk.

        Raises:
            InputError: the weights are not finite, or a checkpoint could not be written.
        """
        trainer.save_checkpoint(self.folder(trainer) / LAST)
        writer(trainer, self).wait()

    def state_dict(self) -> dict[str, Any]:
        """Return the best value, for a resume."""
        return {"best": self.best}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the best value."""
        self.best = state_dict["best"]

    @staticmethod
    def folder(trainer: Trainer) -> Path:
        """Return the folder of the run's checkpoints."""
        return Path(trainer.default_root_dir) / "checkpoints"


def writer(trainer: Trainer, callback: Callback) -> AtomicCheckpointIO:
    """Return the plugin that writes the checkpoints.

    Args:
        trainer: the run's trainer.
        callback: the callback that needs it, for the message.

    Raises:
        InputError: the trainer uses another plugin, as when it was not made by `nerf train`.
    """
    plugin = trainer.strategy.checkpoint_io
    if not isinstance(plugin, AtomicCheckpointIO):
        raise InputError(
            f"The callback {type(callback).__name__} needs the checkpoints that are written beside training: give "
            "Trainer(plugins=[AtomicCheckpointIO()], enable_checkpointing=False), from "
            "nerf_lightning.training.launch.checkpoint_io, and the callback Checkpoints; or leave "
            f"{type(callback).__name__} out, and let Lightning's ModelCheckpoint write."
        )
    return plugin


def _is_finite(train_step: TrainStep) -> bool:
    """Return whether the run is good to return to: its last step was taken, and its weights are finite."""
    return train_step.guard.in_row == 0 and not first_not_finite(train_step.objective.named_weights())

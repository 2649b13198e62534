"""Several replayed steps for one turn of Lightning's loop, where nobody looks at those in between.

Around each batch, Lightning and the callbacks keep the host busy for about a millisecond, longer than a GPU takes to
replay a small step. A callback that acts after some steps alone says after which (`is_due`); in between, steps follow
each other without it. Lightning's counters go on as if each had been a batch of its own, so that checkpoints and
validations are those of a run whose steps are taken one by one.
"""

from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback

from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.nerf.types.rays import Batch
from nerf_lightning.training.callbacks.monitor import Monitor
from nerf_lightning.training.callbacks.progress_bar import TrainingProgress

MOST = 16
"""Clocks, signals and the folder are looked at after so many steps, a few hundredths of a second."""
HOOKS = ("on_train_batch_start", "on_train_batch_end")


class StepsInARow:
    """Tell whether a step may follow the last one at once.

    Args:
        trainer: about to fit.
        system: which it fits.
    """

    def __init__(self, trainer: Trainer, system: Any):
        self.trainer, self.system = trainer, system
        called = [each for each in trainer.callbacks if _has_hooks(each)]  # type: ignore[attr-defined]
        self.asked = [each.is_due for each in called if hasattr(each, "is_due")]
        data = trainer.datamodule  # type: ignore[attr-defined]
        self.possible = (
            len(self.asked) == len(called)  # nobody knows when somebody else's callback acts
            and logs_for(trainer)
            and isinstance(data, RayDataModule)
            and data.batches.prefetch_for is None
            and trainer.max_epochs == -1  # its batches are counted by max_steps
        )

    def another(self, taken: int) -> bool:
        """Tell whether another step follows, after so many in a row."""
        trainer, val_every = self.trainer, self.trainer.val_check_batch
        if not (self.possible and self.system.step.records) or val_every is None:
            return False
        epoch = trainer.fit_loop.epoch_loop
        # Lightning would compare with the batches that it has fetched.
        ends = epoch.batch_progress.is_last_batch = epoch.batch_progress.current.ready >= trainer.num_training_batches
        validates = (epoch.total_batch_idx + 1) % val_every == 0
        if ends or validates or taken == MOST or trainer.should_stop:
            return False
        return not any(is_due(trainer, self.system) for is_due in self.asked)

    def batch(self) -> Batch:
        """Return the next batch; Lightning counts the last one as done, and this one as begun."""
        epoch = self.trainer.fit_loop.epoch_loop
        epoch.batch_progress.increment_processed()
        epoch.batch_progress.increment_completed()
        epoch._batches_that_stepped += 1
        epoch.batch_progress.increment_ready()
        epoch.batch_progress.increment_started()
        batches, progress = self.trainer.datamodule.batches, self.system.step.progress  # type: ignore[attr-defined]
        return batches.at(progress.attempt, progress.rays_seen)


def logs_for(trainer: Trainer) -> bool:
    """Tell whether a callback of ours logs what steps see; else the system does, after each."""
    return any(isinstance(each, Monitor | TrainingProgress) for each in trainer.callbacks)  # type: ignore[attr-defined]


def _has_hooks(callback: Callback) -> bool:
    return any(getattr(type(callback), hook) is not getattr(Callback, hook) for hook in HOOKS)

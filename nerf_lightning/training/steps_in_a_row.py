"""Several replayed steps for one turn of Lightning's loop, where nobody looks at those in between.

Around each batch, Lightning and the callbacks keep the host busy for about a millisecond, longer than a GPU takes to
replay a small step. A callback that acts only after some steps says which (`is_due`); the steps in between do not wait
for it. Lightning's counters go on as if each had been a batch of its own, so that checkpoints and validations are those
of a run whose steps are taken one by one.
"""

from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback

from nerf_lightning.compute import ranks
from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.nerf.types.rays import Batch
from nerf_lightning.training.callbacks.monitor import Monitor
from nerf_lightning.training.callbacks.progress_bar import TrainingProgress

MOST = 16
"""After so many steps at the latest, the clock, the progress bar and the run folder are looked at."""
HOOKS = ("on_train_batch_start", "on_train_batch_end")


class StepsInARow:
    """Tell whether a step may follow the last one at once.

    Args:
        trainer: about to fit.
        system: which it fits.
    """

    def __init__(self, trainer: Trainer, system: Any):
        self.trainer, self.system = trainer, system
        callbacks, data = trainer.callbacks, trainer.datamodule  # type: ignore[attr-defined]
        self.asked = [each.is_due for each in callbacks if hasattr(each, "is_due")]
        self.possible = (
            all(map(_says_when, callbacks))
            and logs_for(trainer)
            and trainer.max_epochs == -1  # the length of the run is max_steps
            and ranks.world_size() == 1  # else all processes would have to decide alike
            and isinstance(data, RayDataModule)
            and data.batches.prefetch_for is None
            and data.batches.whole.ends.device == system.step.device
        )

    def another(self, taken: int) -> bool:
        """Tell whether another step follows, after so many in a row."""
        trainer, val_every = self.trainer, self.trainer.val_check_batch
        if not self.possible or val_every is None:
            return False
        epoch = trainer.fit_loop.epoch_loop
        # Lightning would compare with the batches that it has fetched.
        ends = epoch.batch_progress.is_last_batch = epoch.batch_progress.current.ready >= trainer.num_training_batches
        validates = (epoch.total_batch_idx + 1) % val_every == 0
        if ends or validates or taken == MOST or trainer.should_stop or not self.system.step.recorded:
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


def _says_when(callback: Callback) -> bool:
    """Tell whether a callback acts after no step, or has said when: whoever wrote its hook wrote `is_due`, too."""
    for place in (callback, *type(callback).__mro__):
        if place is Callback or "is_due" in vars(place):
            return True
        if any(hook in vars(place) for hook in HOOKS):
            return False
    return True

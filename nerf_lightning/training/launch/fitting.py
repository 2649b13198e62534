"""What a system takes from the trainer that fits it, ours or Lightning's own: the run's length; and what it refuses."""

import math

from lightning.pytorch import Trainer

from nerf_lightning.checkpoints.format import PRECISIONS
from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.training.launch.strategy import OneSumPerStep


def length_of_run(trainer: Trainer, progress: Progress) -> int:
    """Return the steps from the first to the last: `max_steps`, or as many as the epochs have, whichever ends first.

    Args:
        trainer: about to fit.
        progress: of the system.

    Raises:
        InputError: the run has no end, begins where no run begins, or the trainer would compute something else.
    """
    _require_plain(trainer)
    _require_beginning(trainer, progress)
    trainer.fit_loop.setup_data()  # the number below would ask for it, and say so in the log
    steps = trainer.estimated_stepping_batches
    if math.isinf(steps):
        raise InputError(
            "The run has no end, and the learning rate follows its length: give Trainer max_steps or max_epochs."
        )
    return int(steps)


def _require_beginning(trainer: Trainer, progress: Progress) -> None:
    """Refuse to begin in the midst of a run, or with the rays of another."""
    data = trainer.datamodule  # type: ignore[attr-defined]
    if isinstance(data, RayDataModule) and data.batches.progress is not progress:
        raise InputError(
            "The system and the data are not of the same run: give Trainer.fit run.system and run.data of one "
            "build_run(...)."
        )
    if trainer.ckpt_path is None and trainer.global_step == 0 and progress.rays_seen:
        raise InputError(
            f"This system has been trained for {progress.step} steps, and this fit would begin in their midst. Go on "
            "from a checkpoint (trainer.fit(run.system, run.data, ckpt_path=FILE)), or begin anew with another "
            "build_run(...)."
        )


def _require_plain(trainer: Trainer) -> None:
    """Refuse what Lightning's Trainer would do to a step that does it by itself, or that no step follows."""
    if trainer.precision != "32-true":
        known = ", ".join(PRECISIONS)
        ours = trainer.precision if trainer.precision in PRECISIONS else f"... (one of {known})"
        raise InputError(
            f"Trainer(precision={trainer.precision}) would lower cameras and quadrature too: leave it out, and give "
            f"build_run trainer.precision={ours}, which is for the fields alone."
        )
    if trainer.world_size > 1 and not isinstance(trainer.strategy, OneSumPerStep):
        raise InputError(
            "With several devices Lightning's Trainer would add up gradients in each tile of a step. Use nerf train "
            "trainer=ddp, or Trainer(strategy=OneSumPerStep()) of nerf_lightning.training.launch.strategy."
        )
    again = trainer.overfit_batches  # type: ignore[attr-defined]
    if again:
        raise InputError(
            f"Trainer(overfit_batches={again}) has no effect on rays, of which each step sees others. To learn few "
            "views, give build_run scene.frames."
        )

"""How long a run is, and whether it begins where a run does, as its trainer says: ours, or Lightning's own."""

import math

from lightning.pytorch import Trainer

from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.errors import InputError
from nerf_lightning.nerf.types.progress import Progress


def length_of_run(trainer: Trainer) -> int:
    """Return the steps from the first to the last: `max_steps`, or as many as the epochs have, whichever ends first.

    Raises:
        InputError: it is without end.
    """
    trainer.fit_loop.setup_data()  # the number below would ask for it, and say so in the log
    steps = trainer.estimated_stepping_batches
    if math.isinf(steps):
        raise InputError(
            "The run has no end, and the learning rate follows its length: give Trainer max_steps or max_epochs."
        )
    return int(steps)


def require_beginning(trainer: Trainer, progress: Progress) -> None:
    """Refuse to begin in the midst of a run, or with the rays of another.

    Args:
        trainer: about to fit.
        progress: of the system.

    Raises:
        InputError: the system has been trained already, or the data are not of its run.
    """
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

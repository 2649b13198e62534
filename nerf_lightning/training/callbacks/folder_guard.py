"""A run whose folder is deleted or renamed stops: it would go on in one that has only what was written since."""

from pathlib import Path
from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback

from nerf_lightning.errors import InputError


class FolderGuard(Callback):
    """Look after each step whether the run folder is still there, before anything is written to it."""

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Stop where it is not.

        Raises:
            InputError: the folder was deleted, moved or renamed.
        """
        if trainer.is_global_zero:
            require_run(Path(trainer.default_root_dir))


def require_run(folder: Path) -> None:
    """Refuse to write to the folder of a run that is gone.

    Raises:
        InputError: there is no run in it any more.
    """
    if not (folder / "run.json").is_file():
        raise InputError(
            f"The run folder {folder} was deleted, moved or renamed while the run was going on, so it stops here. If "
            "the folder has another name now, go on with resume=NEW_NAME."
        )

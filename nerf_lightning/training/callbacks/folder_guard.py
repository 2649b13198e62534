"""A run whose folder is deleted or renamed stops: it would go on in one that has only what was written since."""

from pathlib import Path
from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback

from nerf_lightning.files.made_folders import require_run


class FolderGuard(Callback):
    """Look after each step whether the run folder is still there, before anything is written."""

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Stop where it is not.

        Raises:
            InputError: the folder was deleted, moved or renamed.
        """
        if trainer.is_global_zero:
            require_run(Path(trainer.default_root_dir))

"""Stop a run whose folder is deleted or renamed: it would continue in one with only what was written since."""

from pathlib import Path
from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback

from nerf_lightning.files.made_folders import require_run


class FolderGuard(Callback):
    """Check after each step that the run folder still exists, before anything is written."""

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Stop if it does not.

        Raises:
            InputError: the folder was deleted, moved or renamed.
        """
        if trainer.is_global_zero:
            require_run(Path(trainer.default_root_dir))

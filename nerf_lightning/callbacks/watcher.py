"""What looks at a run every few steps, so that a person sees it in TensorBoard."""

from abc import abstractmethod
from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback

from nerf_lightning.errors import require_positive
from nerf_lightning.types.rays import Batch


class Watcher(Callback):
    """Look when it is time; `nerf bench` measures what that costs.

    Nothing that training reads may be changed.

    Args:
        every_steps: steps between two looks.
    """

    def __init__(self, every_steps: int):
        require_positive(every_steps=every_steps)
        self.every_steps = every_steps

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Batch, batch_idx: int) -> None:
        """Look when it is time."""
        if self.is_time(trainer.global_step, trainer.max_steps):
            self.watch(trainer, pl_module, batch)

    def is_time(self, step: int, last_step: int) -> bool:
        """Tell whether to look after a step."""
        return step % self.every_steps == 0

    @abstractmethod
    def watch(self, trainer: Any, system: Any, batch: Batch) -> None:
        """Look at the run; every process of it is asked, the loggers are the first one's."""

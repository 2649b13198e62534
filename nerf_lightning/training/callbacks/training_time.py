"""The time of training itself, without what comes before its first step and after its last."""

import time
from typing import Any, Protocol, runtime_checkable

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback


@runtime_checkable
class Clocked(Protocol):
    """A callback that measures time, in which pauses of training must not count."""

    def leave_out(self, seconds: float) -> None:
        """Do not count the last `seconds`."""


class TrainingTime(Callback):
    """Measure the time from the first step of this start to the end of the last, including validation in between."""

    def __init__(self) -> None:
        self.seconds, self.since = 0.0, 0.0

    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        """Start the clock."""
        self.since = time.monotonic()

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Count the step."""
        now = time.monotonic()
        self.seconds, self.since = self.seconds + now - self.since, now

    def leave_out(self, seconds: float) -> None:
        """Do not count the last `seconds`: training was paused."""
        self.since += seconds

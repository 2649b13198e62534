"""The time of training, and how to train as well as a given one allows: the schedule ends with the time.

The time itself: `budget.seconds` in conf/train.yaml, if that is auto `config/auto_settings.py`.
"""

import math
import signal
import time
from dataclasses import asdict, dataclass
from types import FrameType
from typing import Any, ClassVar, Protocol, runtime_checkable

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback

from nerf_lightning.compute import ranks
from nerf_lightning.messages.errors import InputError


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


@dataclass
class Used:
    """The used part of a budget, as stored in a checkpoint."""

    used: float
    """Seconds,"""
    first: int = 0
    """since this step."""


class TimeBudget(Callback):
    """Stop after `seconds` of training, and stretch the schedule to exactly that length.

    The time that a run has used is part of its state, so a resumed run has the rest; one that had no budget before has
    all of it. The time while the process is stopped (SIGSTOP, Ctrl-Z, a scheduler that suspends jobs) does not count,
    nor does the first step of a process, which may compile kernels for half a minute. Such a run is not
    bit-reproducible: how many steps fit depends on the machine.

    Args:
        seconds: total training time, including validation.
        every_steps: steps between two estimates of the run's length.
    """

    STATE: ClassVar = Used

    def __init__(self, seconds: float, every_steps: int = 10):
        if not 0 < seconds < math.inf:
            raise InputError(f"budget.seconds={seconds}: give a positive time, or null for no budget.")
        self.seconds, self.every_steps = seconds, every_steps
        self.used, self.first, self.since, self.compiles = 0.0, 0, 0.0, True
        self.previous_handler: Any = None

    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        """Install a handler that notices when the process continues; a resumed run knows how fast it was."""
        if hasattr(signal, "SIGCONT"):
            self.previous_handler = signal.signal(signal.SIGCONT, self._woken)
        if self.used:
            self._fit_schedule(trainer, pl_module.train_step)
        else:
            self.first = pl_module.train_step.progress.step

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Estimate the length of the run, and stop when time is over; the first step compiles, and is not counted."""
        now = time.perf_counter()
        if not self.compiles:
            self.used += now - self.since
        self.compiles, self.since = False, now
        is_time = pl_module.train_step.progress.step % self.every_steps == 0
        if ranks.world_size() > 1:
            # All stop at the same step, by the slowest clock; comparing them in each step would take time.
            if not is_time:
                return
            self.used = ranks.largest(self.used)
        if self.used and is_time:
            self._fit_schedule(trainer, pl_module.train_step)
        if self.used >= self.seconds:
            trainer.should_stop = True

    def leave_out(self, seconds: float) -> None:
        """Do not count the last `seconds`: training was paused."""
        self.since += seconds

    def teardown(self, trainer: Trainer, pl_module: Any, stage: str) -> None:
        """Restore the handler."""
        if self.previous_handler is not None:
            signal.signal(signal.SIGCONT, self.previous_handler)
            self.previous_handler = None

    def state_dict(self) -> dict[str, Any]:
        """Return the time used, for a resume."""
        return asdict(Used(self.used, self.first))

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the count."""
        known = Used(**state_dict)
        self.used, self.first = known.used, known.first

    def _woken(self, number: int, frame: FrameType | None) -> None:
        # When the stop began is unknown, so the part of the step before it does not count either.
        self.since = time.perf_counter()

    def _fit_schedule(self, trainer: Trainer, train_step: Any) -> None:
        step = train_step.progress.step
        expected = self.first + int((step - self.first) * self.seconds / self.used)
        train_step.num_steps = min(int(trainer.estimated_stepping_batches), max(step + 1, expected))

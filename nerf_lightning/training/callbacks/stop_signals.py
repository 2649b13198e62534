"""On Ctrl-C, SIGTERM, a scheduler's signal or a sweep's stop: finish the step, save, stop; without its folder, stop.

What is said then, with the command that resumes: `commands/train_job/fit.py`.
"""

import os
import signal
from pathlib import Path
from types import FrameType
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from nerf_lightning.compute import ranks
from nerf_lightning.files.made_folders import require_run
from nerf_lightning.messages.exit_codes import OF_SIGNALS
from nerf_lightning.training.launch.preemption import stop_signals


class StopSignals(Callback):
    """Set a flag in the signal handler, and stop at the end of a step.

    The checkpoint itself is written when training ends (`Checkpoints`). A handler that saved would save half a step. A
    second Ctrl-C stops at once.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self.stop_file: Path | None = None
        """A file whose existence requests a stop, like SIGTERM, which on Windows would end the process at once."""
        self.heard = False  # a signal, not only the file
        self.previous_handlers: dict[int, Any] = {}

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Remember the handlers from before Lightning's, which would keep a finished trainer alive and deaf."""
        self.previous_handlers = {number: signal.getsignal(number) for number in stop_signals()}

    def on_sanity_check_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Listen."""
        self._listen()

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Listen; Lightning installs its own handler shortly before.

        Raises:
            SystemExit: that handler has received a signal. No step was taken, so there is nothing to save
                (`preemption`).
        """
        if ranks.largest(float(trainer.received_sigterm)):
            raise SystemExit(OF_SIGNALS + signal.SIGTERM)
        self._listen()

    def asked_to_stop(self) -> bool:
        """Return whether a signal or the file requests a stop."""
        if self.received is None and self.stop_file is not None and self.stop_file.exists():
            self.received = signal.SIGTERM
        return self.received is not None

    def on_train_batch_end(self, trainer: Any, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Stop after a complete step, all processes at the same one."""
        self.asked_to_stop()
        received = int(ranks.largest(float(self.received or 0)))
        if received:
            self.received = received
            trainer.should_stop = True

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Restore the handlers."""
        for number, handler in self.previous_handlers.items():
            signal.signal(number, handler)
        self.previous_handlers.clear()

    def _listen(self) -> None:
        for number in stop_signals():
            signal.signal(number, self._handle)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.heard and number == signal.SIGINT:
            os._exit(OF_SIGNALS + number)  # an exception would be caught on the way, and the process would linger
        self.heard, self.received = True, number


class FolderGuard(Callback):
    """Check after each step that the run folder still exists, before anything is written."""

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Stop if it does not.

        Raises:
            InputError: the folder was deleted, moved or renamed.
        """
        if trainer.is_global_zero:
            require_run(Path(trainer.default_root_dir))

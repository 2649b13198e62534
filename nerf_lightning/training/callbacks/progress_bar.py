"""One line with the progress of training: step, loss, PSNR, rays per second, time left.

From when on it shows the time left: FORESEEN_FROM in `messages/console.py`.
"""

import logging
import time
from typing import Any

import torch
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import ProgressBar
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from nerf_lightning.messages.console import FORESEEN_FROM, spoken
from nerf_lightning.nerf.objective import StepOutput
from nerf_lightning.nerf.psnr import psnr
from nerf_lightning.training.launch.trainer import MOST_STEPS

log = logging.getLogger(__name__)


class TrainingProgress(ProgressBar):
    """A bar on a terminal; elsewhere an occasional line in the log.

    Args:
        refresh_seconds: time between two updates of the bar; the loss is read from the device only then.
        line_seconds: time between two lines where stderr is not a terminal.
    """

    def __init__(self, refresh_seconds: float = 0.5, line_seconds: float = 30.0):
        super().__init__()
        self.refresh_seconds, self.line_seconds = refresh_seconds, line_seconds
        self.bar: Progress | None = None
        self.silent = False
        self.task = TaskID(0)
        self.started: float | None = None
        self.first_step, self.last_update, self.rays_seen = 0, 0.0, 0

    def disable(self) -> None:
        """Stay silent: Lightning calls this in every process but the first."""
        self.silent = True

    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        """Show the bar."""
        self.started = None
        console = Console(stderr=True)
        if self.silent or not console.is_terminal:
            return
        self.bar = Progress(
            TextColumn("step {task.fields[step]}"),
            BarColumn(bar_width=None),
            TextColumn("{task.description}"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[remaining]}"),
            console=console,
            expand=True,
        )
        self.task = self.bar.add_task("", total=None, step=f"{trainer.global_step:,}", remaining="")
        self.bar.start()

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Update what is shown."""
        now, step = time.perf_counter(), trainer.global_step
        if self.started is None:  # the first step compiles kernels, and is not representative
            self.started = self.last_update = now
            self.first_step, self.rays_seen = step, pl_module.train_step.progress.rays_seen
            return
        if self.silent or now - self.last_update < (self.line_seconds if self.bar is None else self.refresh_seconds):
            return
        rays_seen = pl_module.train_step.progress.rays_seen
        # Negative after a restart, which resets the count.
        rays_per_second = max(0.0, (rays_seen - self.rays_seen) / (now - self.last_update))
        self.last_update, self.rays_seen = now, rays_seen
        output: StepOutput = outputs["step"]
        loss, quality = torch.stack([output.losses.sum(), psnr(output.color_errors[-1])]).tolist()
        text = f"loss {loss:.4f}  PSNR {quality:.1f} dB  {rays_per_second:,.0f} rays/s"
        total = _total(trainer, pl_module)
        remaining = "" if total is None else self._remaining(step, total, now - self.started)
        where = f"{step}" if total is None else f"{step}/{total}"
        if self.bar is not None:
            self.bar.update(self.task, completed=step, total=total, description=text, step=where, remaining=remaining)
        else:
            log.info("step %s  %s%s", where, text, remaining and f"  {remaining}")

    def _remaining(self, step: int, total: int, seconds: float) -> str:
        """Return the time left after `seconds`, once enough of the run is over to estimate it."""
        done, asked = step - self.first_step, total - self.first_step
        return "" if done < max(1, FORESEEN_FROM * asked) else f"about {spoken((total - step) * seconds / done)} left"

    def leave_out(self, seconds: float) -> None:
        """Do not count the last `seconds`: training was paused."""
        if self.started is not None:
            self.started += seconds
        self.last_update += seconds

    def on_train_end(self, trainer: Trainer, pl_module: Any) -> None:
        """Leave the finished bar on the screen."""
        self._stop(trainer.global_step)

    def on_exception(self, trainer: Trainer, pl_module: Any, exception: BaseException) -> None:
        """Release the terminal."""
        self._stop(trainer.global_step)

    def _stop(self, step: int) -> None:
        if self.bar is not None:
            self.bar.update(self.task, completed=step, total=step, step=f"{step:,}", remaining="")
            self.bar.stop()
            self.bar = None


def _total(trainer: Trainer, pl_module: Any) -> int | None:
    """Return the length of the run in steps; with a time budget an estimate, None if there is none yet."""
    total = pl_module.train_step.num_steps
    if total >= MOST_STEPS:
        return None
    return total if total >= trainer.estimated_stepping_batches else max(total, trainer.global_step + 1)

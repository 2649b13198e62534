"""One line that says how far the training is: step, loss, PSNR, rays per second, time left."""

import logging
import time
from typing import Any

import torch
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import ProgressBar
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from nerf_lightning.messages.console import spoken
from nerf_lightning.nerf.psnr import psnr
from nerf_lightning.training.step_output import StepOutput

log = logging.getLogger(__name__)


LONG = 3 * 3600.0  # Seconds: who trains longer is told how not to.


class TrainingProgress(ProgressBar):
    """A bar on a terminal; elsewhere a line in the log now and then.

    Args:
        refresh_seconds: time between two updates of the bar; the loss is read from the device only then.
        line_seconds: time between two lines where stderr is not a terminal.
    """

    def __init__(self, refresh_seconds: float = 0.5, line_seconds: float = 30.0):
        super().__init__()
        self.refresh_seconds, self.line_seconds = refresh_seconds, line_seconds
        self.bar: Progress | None = None
        self.silent = self.warned = False
        self.task = TaskID(0)
        self.started, self.first_step, self.shown, self.rays_seen = 0.0, 0, 0.0, 0

    def disable(self) -> None:
        """Stay silent: Lightning asks it of every process but the first."""
        self.silent = True

    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        """Show the bar."""
        self.started = self.shown = time.perf_counter()
        self.first_step = trainer.global_step
        self.rays_seen = pl_module.step.progress.rays_seen
        console = Console(stderr=True)
        if self.silent or not console.is_terminal:
            return
        self.bar = Progress(
            TextColumn("step {task.completed:,.0f}/{task.total:,.0f}"),
            BarColumn(bar_width=None),
            TextColumn("{task.description}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
            expand=True,
        )
        self.task = self.bar.add_task("", total=pl_module.step.num_steps, completed=trainer.global_step)
        self.bar.start()

    def is_due(self, trainer: Trainer, pl_module: Any) -> bool:
        """Never: it ends no row of steps (`StepsInARow`)."""
        return False

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Update what is shown."""
        now, step = time.perf_counter(), trainer.global_step
        if self.silent or now - self.shown < (self.line_seconds if self.bar is None else self.refresh_seconds):
            return
        per_second = (step - self.first_step) / (now - self.started)
        # Negative after a restart, which counts anew.
        rays_per_second = max(0.0, (pl_module.step.progress.rays_seen - self.rays_seen) / (now - self.shown))
        self.shown, self.rays_seen = now, pl_module.step.progress.rays_seen
        self._warn_of_hours((pl_module.step.num_steps - step) / per_second)
        output: StepOutput = outputs["step"]
        loss, quality = torch.stack([output.losses.sum(), psnr(output.color_errors[-1])]).tolist()
        text = f"loss {loss:.4f}  PSNR {quality:.1f} dB  {rays_per_second:,.0f} rays/s"
        if self.bar is not None:
            self.bar.update(self.task, completed=step, total=pl_module.step.num_steps, description=text)
        else:
            left = (pl_module.step.num_steps - step) / per_second
            log.info("step %d/%d  %s  about %s left", step, pl_module.step.num_steps, text, spoken(left))

    def leave_out(self, seconds: float) -> None:
        """Do not count the last so many seconds: the training paused."""
        self.started += seconds
        self.shown += seconds

    def _warn_of_hours(self, left: float) -> None:
        if left > LONG and not self.warned:
            self.warned = True
            log.warning(
                "At this speed the training takes another %s. model=auto (fast, or fast_proposal for photographs) "
                "trains the same scene in minutes, and budget.seconds=300 ends it in five.",
                spoken(left),
            )

    def on_train_end(self, trainer: Trainer, pl_module: Any) -> None:
        """Leave the finished bar on the screen."""
        self._stop(trainer.global_step)

    def on_exception(self, trainer: Trainer, pl_module: Any, exception: BaseException) -> None:
        """Give the terminal back."""
        self._stop(trainer.global_step)

    def _stop(self, step: int) -> None:
        if self.bar is not None:
            self.bar.update(self.task, completed=step)
            self.bar.stop()
            self.bar = None

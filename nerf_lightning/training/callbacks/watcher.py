"""Callbacks that observe a run every few steps, the view they render, and their direct access to TensorBoard."""

import threading
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import Logger, TensorBoardLogger
from torch.utils.tensorboard import SummaryWriter

from nerf_lightning.messages.errors import require_positive
from nerf_lightning.nerf.models.render_image import Picture, render_picture
from nerf_lightning.nerf.types.rays import Batch
from nerf_lightning.visualization.pictures import LONGEST_PANEL


class Watcher(Callback):
    """Observe the run at intervals.

    Subclasses must not change anything that training reads.

    Args:
        every_steps: steps between two observations.
    """

    def __init__(self, every_steps: int):
        require_positive(every_steps=every_steps)
        self.every_steps = every_steps

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Batch, batch_idx: int) -> None:
        """Observe when it is time."""
        if self.is_time(trainer.global_step, int(trainer.estimated_stepping_batches)):
            self.watch(trainer, pl_module, outputs)

    def is_time(self, step: int, last_step: int) -> bool:
        """Return whether to observe after a step."""
        return step % self.every_steps == 0

    @abstractmethod
    def watch(self, trainer: Any, system: Any, outputs: Any) -> None:
        """Observe the run and the output of its last step.

        This is called in every process; only the first has the loggers.
        """


WRITES = "tensorboard.summary.writer.event_file_writer"
"""Module that defines the class of the writer thread."""


def tensorboard_writers(loggers: Sequence[Logger]) -> list[SummaryWriter]:
    """Return the writers of the TensorBoard loggers among `loggers`."""
    return [logger.experiment for logger in loggers if isinstance(logger, TensorBoardLogger)]


@contextmanager
def errors_told_once() -> Iterator[None]:
    """Keep TensorBoard's threads from printing when they cannot write, as when the disk is full.

    They keep the error, and raise it at the next write or flush.
    """
    former = threading.excepthook

    def quiet(failure: threading.ExceptHookArgs) -> None:
        if not (isinstance(failure.exc_value, OSError) and _writes(failure.thread)):
            former(failure)

    threading.excepthook = quiet
    try:
        yield
    finally:
        for thread in filter(_writes, threading.enumerate()):
            if getattr(thread, "exception", None) is not None:
                thread.join()  # it is about to raise
        threading.excepthook = former


def _writes(thread: threading.Thread | None) -> bool:
    return type(thread).__module__ == WRITES


def render_validation_view(trainer: Any, system: Any, number: int) -> tuple[int, Picture]:
    """Return validation view `number` (modulo their count) and its picture, in the precision of training.

    If there are none, a training view. The picture is no larger than needed to show it.
    """
    scene = trainer.datamodule.scene
    views = scene.splits["val"] or scene.splits["train"]
    view = views[number % len(views)]
    tile_points = system.train_step.tiles.picture_points
    system.eval()
    rays = system.rays.at_most(LONGEST_PANEL)
    picture = render_picture(system.model, rays, view, scene.background, tile_points)
    system.train()
    return view, picture

"""Direct ways to TensorBoard, for pictures and text that Lightning's loggers have no words for, and its errors."""

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from lightning.pytorch.loggers import Logger, TensorBoardLogger
from torch.utils.tensorboard import SummaryWriter

WRITES = "tensorboard.summary.writer.event_file_writer"
"""Where the class of the thread that writes is defined."""


def tensorboard_writers(loggers: Sequence[Logger]) -> list[SummaryWriter]:
    """Return the writers of the TensorBoard loggers among `loggers`."""
    return [logger.experiment for logger in loggers if isinstance(logger, TensorBoardLogger)]


@contextmanager
def errors_told_once() -> Iterator[None]:
    """Let TensorBoard's threads print nothing when they cannot write, as where the disk is full.

    They keep the error, and whoever writes next, or flushes, raises it.
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
                thread.join()  # it is about to say so
        threading.excepthook = former


def _writes(thread: threading.Thread | None) -> bool:
    return type(thread).__module__ == WRITES

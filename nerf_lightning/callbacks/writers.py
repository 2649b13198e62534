"""Direct ways to TensorBoard, for pictures and text that Lightning's loggers have no words for."""

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from lightning.pytorch.loggers import Logger, TensorBoardLogger
from tensorboard.summary.writer.event_file_writer import _AsyncWriterThread
from torch.utils.tensorboard import SummaryWriter


def tensorboard_writers(loggers: Sequence[Logger]) -> list[SummaryWriter]:
    """Return the writers of the TensorBoard loggers among `loggers`."""
    return [logger.experiment for logger in loggers if isinstance(logger, TensorBoardLogger)]


@contextmanager
def failures_told_once() -> Iterator[None]:
    """Keep a full disk or a lost folder from being told twice.

    What stops TensorBoard's thread is raised where something is given to it next, or when it is flushed; Python would
    print a traceback before.
    """
    former = threading.excepthook

    def told(failure: threading.ExceptHookArgs) -> None:
        if not (isinstance(failure.thread, _AsyncWriterThread) and isinstance(failure.exc_value, OSError)):
            former(failure)

    threading.excepthook = told
    try:
        yield
    finally:
        threading.excepthook = former

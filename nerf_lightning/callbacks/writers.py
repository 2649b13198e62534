"""Direct ways to TensorBoard, for pictures and text that Lightning's loggers have no words for."""

from collections.abc import Sequence

from lightning.pytorch.loggers import Logger, TensorBoardLogger
from torch.utils.tensorboard import SummaryWriter


def tensorboard_writers(loggers: Sequence[Logger]) -> list[SummaryWriter]:
    """Return the writers of the TensorBoard loggers among `loggers`."""
    return [logger.experiment for logger in loggers if isinstance(logger, TensorBoardLogger)]

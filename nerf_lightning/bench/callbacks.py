"""`nerf bench`: what it costs that a run can be watched in TensorBoard."""

import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from types import SimpleNamespace
from typing import Any

from lightning.pytorch.loggers import TensorBoardLogger
from torch.optim import Optimizer

from nerf_lightning.compute.machine import seconds_of
from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.nerf.types.rays import Batch
from nerf_lightning.training.callbacks.watcher import Watcher
from nerf_lightning.training.step import TrainStep
from nerf_lightning.training.system import RadianceFieldSystem

# A first look may have to load or compile something. A long one is not repeated: it counts for little there.
LONG_SECONDS = 5.0


def watching_seconds(
    watchers: Iterable[Watcher], step: TrainStep, optimizer: Optimizer, data: RayDataModule, batch: Batch
) -> dict[str, float]:
    """Return the seconds that each watcher adds to a step: those of one look, spread over the steps between two.

    One step is taken, so that there is something to look at.
    """
    seconds = {}
    outputs = {"step": step(batch, optimizer, measure_gradients=True)}
    with _trainer(data) as trainer:
        system = RadianceFieldSystem(step, {})
        setattr(system, "optimizers", lambda: optimizer)  # noqa: B010  Lightning's are its trainer's
        for watcher in watchers:
            look = partial(watcher.watch, trainer, system, outputs)
            first = seconds_of(look)
            taken = first if first > LONG_SECONDS else seconds_of(look)
            seconds[type(watcher).__name__] = taken / watcher.every_steps
    return seconds


@contextmanager
def _trainer(data: RayDataModule) -> Iterator[Any]:
    """Stand in for Lightning's trainer, with what watchers ask of it."""
    with tempfile.TemporaryDirectory() as folder:
        logger = TensorBoardLogger(folder)
        yield SimpleNamespace(
            global_step=1, max_steps=1, is_global_zero=True, default_root_dir=folder, datamodule=data, loggers=[logger]
        )
        logger.finalize("success")

"""What a system takes from the trainer that fits it, ours or Lightning's (the run's length), and what it refuses."""

import logging
import math
from collections.abc import Iterator

import torch
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import (
    BatchSizeFinder,
    GradientAccumulationScheduler,
    LearningRateFinder,
    ModelPruning,
    Timer,
)
from lightning.pytorch.strategies import DDPStrategy, SingleDeviceStrategy
from torch import nn

from nerf_lightning.checkpoints.format import PRECISIONS
from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.part import coupled_parts
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.training.callbacks.time_budget import TimeBudget
from nerf_lightning.training.launch.trainer import OneSumPerStep
from nerf_lightning.training.step import TrainStep

log = logging.getLogger(__name__)


def length_of_run(trainer: Trainer, progress: Progress) -> int:
    """Return the number of steps of the run: `max_steps`, or those of the epochs, whichever ends first.

    Args:
        trainer: the trainer that is about to fit.
        progress: the system's progress.

    Raises:
        InputError: the run has no end, does not begin at the start, or the trainer would compute something else.
    """
    _require_beginning(trainer, progress)
    _warn_of_timer(trainer)
    trainer.fit_loop.setup_data()  # the property below would do this, with a log message
    steps = trainer.estimated_stepping_batches
    if math.isinf(steps):
        raise InputError(
            "The run has no end, and the learning rate follows its length: give Trainer max_steps or max_epochs."
        )
    return int(steps)


def _require_beginning(trainer: Trainer, progress: Progress) -> None:
    """Refuse to begin in the middle of a run, or with the rays of another."""
    data = trainer.datamodule  # type: ignore[attr-defined]
    if isinstance(data, RayDataModule) and data.batches.progress is not progress:
        raise InputError(
            "The system and the data are not of the same run: give Trainer.fit run.system and run.data of one "
            "build_run(...)."
        )
    if trainer.ckpt_path is None and trainer.global_step == 0 and progress.rays_seen:
        raise InputError(
            f"This system has been trained for {progress.step} steps, and this fit would begin in their midst. Go on "
            "from a checkpoint (trainer.fit(run.system, run.data, ckpt_path=FILE)), or begin anew with another "
            "build_run(...)."
        )


def require_fitting(trainer: Trainer) -> None:
    """Refuse a trainer that would repeat what a step does by itself, or that requests what steps do not support.

    Raises:
        InputError: says what to set instead.
    """
    require_one_process(trainer.lightning_module.train_step, trainer.world_size)  # type: ignore[arg-type]
    reasons = [*_of_settings(trainer), *_of_devices(trainer), *_of_callbacks(trainer)]
    if reasons:
        raise InputError(reasons[0])
    if torch.are_deterministic_algorithms_enabled() and not torch.is_deterministic_algorithms_warn_only_enabled():
        require_deterministic(trainer.lightning_module, trainer.strategy.root_device.type)


def require_one_process(train_step: TrainStep, world_size: int) -> None:
    """Refuse several processes if a part depends on all rays of a step.

    Raises:
        InputError: names its class.
    """
    coupled = coupled_parts(train_step.objective)
    if coupled and world_size > 1:
        raise InputError(
            f"{coupled[0]} looks at all rays of a step, and {world_size} processes share them: train in one "
            "(trainer.devices=1)."
        )


def _of_settings(trainer: Trainer) -> Iterator[str]:
    again, clip = trainer.overfit_batches, trainer.gradient_clip_val  # type: ignore[attr-defined]
    if trainer.precision != "32-true":
        ours = trainer.precision if trainer.precision in PRECISIONS else f"... (one of {', '.join(PRECISIONS)})"
        yield (
            f"Trainer(precision={trainer.precision}) would lower cameras and quadrature too: leave it out, and give "
            f"build_run trainer.precision={ours}, which is for the fields alone."
        )
    if again:
        yield (
            f"Trainer(overfit_batches={again}) has no effect on rays, of which each step sees others. To learn few "
            "views, give build_run scene.frames."
        )
    if clip:
        yield (
            f"Trainer(gradient_clip_val={clip}) would clip each tile of a step. Leave it out, and give build_run "
            f"trainer.clip_norm={clip}."
        )


def _of_devices(trainer: Trainer) -> Iterator[str]:
    if not isinstance(trainer.strategy, SingleDeviceStrategy | DDPStrategy):
        yield (
            f"{type(trainer.strategy).__name__} divides weights among devices, and a step needs all of them. Leave "
            "Trainer(strategy=...) out, or use nerf train trainer=ddp for several devices."
        )
    if trainer.world_size > 1 and not isinstance(trainer.strategy, OneSumPerStep):
        yield (
            "With several devices Lightning's Trainer would add up gradients in each tile of a step. Use nerf train "
            "trainer=ddp, or Trainer(strategy=OneSumPerStep()) of nerf_lightning.training.launch.trainer."
        )


def _of_callbacks(trainer: Trainer) -> Iterator[str]:
    if trainer.accumulate_grad_batches != 1 or _has(trainer, GradientAccumulationScheduler):
        yield (
            "A step already adds up the gradients of its tiles. Leave Trainer(accumulate_grad_batches=...) and "
            "GradientAccumulationScheduler out, and give build_run a larger data.batch_rays."
        )
    if _has(trainer, BatchSizeFinder):
        yield (
            "BatchSizeFinder finds no batch size: a batch is rays, cut into tiles that fit the memory. Leave it out, "
            "and give build_run data.batch_rays."
        )
    if _has(trainer, LearningRateFinder):
        yield "LearningRateFinder takes steps that a run would count. Leave it out, and give build_run optimizer.lr."
    if _has(trainer, ModelPruning):
        yield (
            "ModelPruning replaces the weights that the step and its kernels hold. Leave it out; a smaller model is "
            "model=fast_small or field.width."
        )


def _has(trainer: Trainer, kind: type) -> bool:
    return any(isinstance(each, kind) for each in trainer.callbacks)  # type: ignore[attr-defined]


def require_deterministic(module: nn.Module, device_type: str) -> None:
    """Refuse to promise bit-reproducible runs if sums are taken in arbitrary order.

    Args:
        module: the module that is trained.
        device_type: the device's type.

    Raises:
        InputError: it has hash grids, and trains on an NVIDIA GPU.
    """
    if device_type == "cuda" and any(isinstance(part, HashGridEncoder) for part in module.modules()):
        raise InputError(
            "trainer.deterministic=true (Trainer(deterministic=True)) cannot be kept: on a GPU the gradients of hash "
            "grids are sums by atomic additions, whose order varies. Leave it out, train on a CPU, or choose a model "
            "without hash grids, such as model=nerf."
        )


def _warn_of_timer(trainer: Trainer) -> None:
    """Warn that a run ended by Lightning's timer may end with a high learning rate."""
    callbacks = trainer.callbacks  # type: ignore[attr-defined]
    ends = any(isinstance(each, Timer) and each.time_remaining() is not None for each in callbacks)
    if ends and not _has(trainer, TimeBudget):
        log.warning(
            "Lightning's Timer (max_time) may end this run before its last step, and with the learning rate still "
            "high. Use Trainer(max_steps=1_000_000, callbacks=[TimeBudget(seconds=...)]) of nerf_lightning.training."
            "callbacks.time_budget, or nerf train budget.seconds=N: the rate follows the time."
        )

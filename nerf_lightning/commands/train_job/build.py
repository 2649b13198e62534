"""What `nerf train` adds to a run: callbacks, loggers, the doctor, and what follows the training."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from lightning.pytorch import Callback
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.commands.train_job.evaluate_and_film import PostTraining
from nerf_lightning.compute import ranks
from nerf_lightning.config.auto_settings import AUTO
from nerf_lightning.config.compose import Composed, picked
from nerf_lightning.config.exporters import exporters_after_training
from nerf_lightning.config.instantiate import build
from nerf_lightning.config.overrides import quoted
from nerf_lightning.messages.console import say
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.types.scene import Scene
from nerf_lightning.runs.plan_run import Run, plan_run
from nerf_lightning.runs.resume import former_config
from nerf_lightning.runs.run_folder import job_folder
from nerf_lightning.runs.sweep_job import stop_file
from nerf_lightning.training.callbacks.checkpoints import Checkpoints
from nerf_lightning.training.callbacks.stop_signals import FolderGuard, StopSignals
from nerf_lightning.training.callbacks.time_budget import TimeBudget, TrainingTime
from nerf_lightning.training.launch.processes import require_one_task
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.loggers import WeightsAndBiases


@dataclass
class TrainJob(Run):
    """Everything that `nerf train` adds, except its place on disk."""

    num_steps: int
    signals: StopSignals
    clock: TrainingTime
    """One of the callbacks."""
    callbacks: list[Callback]
    loggers: dict[str, Any]
    """Factories that open them in the run's folder."""
    post_training: PostTraining


def build_job(config: DictConfig, scene: Scene | None = None) -> TrainJob:
    """Build what a command's config specifies, and read its scene if none is given; nothing is written."""
    requested = composed("train", config, ranks.from_first(lambda: former_config(config, job_folder())))
    if job_folder() is not None and config.final.get("page") == AUTO:
        requested = requested.with_setting("final.page", False)  # the runs of a sweep are compared, not handed over
    job = assemble_job(requested, scene)
    if job_folder() is not None:
        job.signals.stop_file = stop_file(Path(HydraConfig.get().sweep.dir))
    return job


def assemble_job(requested: Composed, scene: Scene | None = None) -> TrainJob:
    """Build all parts of a `nerf train` run and read its scene; nothing is written.

    What the config leaves open is chosen for the scene; checkpoints keep the choices.

    Raises:
        InputError: the config or the capture does not allow a run.
    """
    settings: TrainerSettings = build(requested.config.trainer)
    if settings.launched_by == "nerf":
        require_one_task()
    settings.prepare_machine()
    post_training, loggers = PostTraining.from_config(requested.config), build(requested.config.logger)
    for each in loggers.values() if ranks.is_first() else ():
        if isinstance(each, WeightsAndBiases):
            each.require_access()
    run = plan_run(requested, settings, scene)
    config = run.config
    post_training.exports = exporters_after_training(config.final)  # of what was left open, too
    post_training.require_film(run.scene)
    if post_training.scoring is not None:
        post_training.scoring.max_views = config.evaluation.max_views
    post_training.require_density(run.system.model)
    num_rays, data = run.data.batches.whole.num_rays, config.data
    signals, clock = StopSignals(), TrainingTime()
    if config.print_config and ranks.is_first():
        say(*OmegaConf.to_yaml(config, resolve=True).splitlines())
    return TrainJob(
        **vars(run),
        num_steps=settings.num_steps(num_rays, data.batch_rays, data.crop_steps),
        signals=signals,
        clock=clock,
        callbacks=_callbacks(config, signals, clock),
        loggers=loggers,
        post_training=post_training,
    )


def composed(command: str, config: DictConfig, resumed: Mapping[str, Any] | None = None) -> Composed:
    """Return the config of this command with its overrides, to compose again what is left open."""
    hydra = HydraConfig.get()
    overrides = [*searchpath_override(), *hydra.overrides.task]
    return Composed(command, config, picked(hydra.runtime.choices), overrides, resumed)


def searchpath_override() -> list[str]:
    """Return the override that names folders with the user's own YAMLs (`--config-dir`), if any."""
    hydra = HydraConfig.get()
    named = [source.path for source in hydra.runtime.config_sources if source.provider == "command-line"]
    if named:
        return [f"hydra.searchpath={quoted([*hydra.searchpath, *named])}"]
    return [each for each in hydra.overrides.hydra if each.startswith("hydra.searchpath=")]


def _callbacks(config: DictConfig, signals: StopSignals, clock: TrainingTime) -> list[Callback]:
    chosen = build(config.callbacks)
    for name, callback in chosen.items():
        if not isinstance(callback, Callback):
            raise InputError(f"callbacks.{name}={callback} is not a callback. To remove one, add ~callbacks.{name}.")
    callbacks: list[Callback] = [signals, clock, FolderGuard(), *chosen.values()]
    if "live_view" in config.viewer:
        callbacks.append(build(config.viewer.live_view))
    if config.budget.seconds is not None:
        callbacks.append(TimeBudget(float(config.budget.seconds)))
    # Checkpoints come last, so that they save what the others left.
    return sorted(callbacks, key=lambda callback: isinstance(callback, Checkpoints))

"""What a run is made of, from its config: scene, data, system; and for `nerf train` callbacks, and what follows."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import yaml
from lightning.pytorch import Callback
from omegaconf import DictConfig, OmegaConf

from nerf_lightning import ranks
from nerf_lightning.budgets import Budgets, allow
from nerf_lightning.checkpoints.reading import Checkpoint, make_record, read_checkpoint
from nerf_lightning.config.compose import chosen, compose_config
from nerf_lightning.config.instantiate import build, required_path
from nerf_lightning.config.load_model import hold_to_budgets, load_weights
from nerf_lightning.config.overrides import key_of
from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.data.pixels.hashes import photograph_hashes
from nerf_lightning.doctor.check import Check
from nerf_lightning.doctor.gate import require_sound, warn_of_faults
from nerf_lightning.errors import InputError
from nerf_lightning.nerf.corrections.base import Correction
from nerf_lightning.nerf.losses.base import Loss
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.looking import show_photographs
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.refinements.base import Refinement
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.nerf.types.scene import Scene
from nerf_lightning.training.auto_settings import corrected, settled
from nerf_lightning.training.callbacks.checkpoints import Checkpoints
from nerf_lightning.training.callbacks.folder_guard import FolderGuard
from nerf_lightning.training.callbacks.stop_signals import StopSignals
from nerf_lightning.training.callbacks.time_budget import TimeBudget
from nerf_lightning.training.callbacks.training_time import TrainingTime
from nerf_lightning.training.evaluate_and_film import Finish
from nerf_lightning.training.launch import xla
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.loggers import WeightsAndBiases
from nerf_lightning.training.step import TrainStep
from nerf_lightning.training.system import RadianceFieldSystem

OF_LIGHTNINGS_TRAINER = {
    "trainer.max_steps": "Trainer(max_steps=...)",
    "trainer.max_epochs": "Trainer(max_epochs=...)",
    "trainer.val_every_steps": "Trainer(val_check_interval=...)",
    "trainer.lightning": "Trainer(...)",
    "callbacks": "Trainer(callbacks=[...])",
    "viewer": "Trainer(callbacks=[LiveView(...)])",
    "budget": "Trainer(callbacks=[TimeBudget(...)])",
    "logger": "Trainer(logger=...)",
    "paths": "Trainer(default_root_dir=...)",
    "resume": "Trainer.fit(..., ckpt_path=...)",
}
"""Settings of `nerf train` that are given to Lightning's own Trainer in a notebook."""

log = logging.getLogger(__name__)


@dataclass
class Run:
    """What learns, and from what: all that Lightning's Trainer needs."""

    settings: TrainerSettings
    scene: Scene
    data: RayDataModule
    system: RadianceFieldSystem


@dataclass
class Parts(Run):
    """What `nerf train` adds, but for its place on the disk."""

    config: DictConfig
    """Nothing in it is left open."""
    checks: list[Check] | None
    """What the doctor says of the scene, where it was asked."""
    num_steps: int
    signals: StopSignals
    clock: TrainingTime
    """One of the callbacks."""
    callbacks: list[Callback]
    loggers: dict[str, Any]
    """What opens them in the run's folder."""
    finish: Finish


def build_run(*overrides: str, model: Model | None = None, loss: Loss | None = None) -> Run:
    """Build what `nerf train OVERRIDES` trains, for `Trainer.fit(run.system, run.data)`; nothing is written.

    Its weights are functions of the seed. A run is fitted once; to go on from a checkpoint, another is built.

    Args:
        *overrides: as on the command line, like "scene=bricks" and "model=nerf_tiny".
        model: one of your own in the place of the config's; its weights are drawn anew from the seed. A checkpoint of
            it is opened by whoever builds it again, as here, with `ckpt_path`, and not by the commands.
        loss: one of your own in the place of the config's.

    Raises:
        InputError: anything in the settings or in the capture that makes no run, or a setting of Lightning's Trainer.
    """
    _refuse_settings_of_the_trainer(overrides)
    config, choices = compose_config("train", overrides)
    allow(Budgets(**config.budgets))
    settings: TrainerSettings = build(config.trainer)
    settings.prepare_machine()
    scene: Scene = build(config.scene).read()
    config, choices = settled(config, choices, overrides, scene)
    config, choices = corrected(config, choices, overrides, checks=None)
    run = _run(config, choices, settings, scene, model, loss)
    settings.prepare(run.system.model)
    run.system.record["precision"] = settings.precision
    return run


def _refuse_settings_of_the_trainer(overrides: Sequence[str]) -> None:
    for override in overrides:
        key = key_of(override)
        for setting, instead in OF_LIGHTNINGS_TRAINER.items():
            if key == setting or key.startswith((f"{setting}.", f"{setting}@")):
                raise InputError(f"{override}: this is for Lightning's Trainer to say here: {instead}.")


def build_parts(
    config: DictConfig,
    choices: Mapping[str, Any],
    overrides: Sequence[str],
    former: Mapping[str, Any] | None = None,
) -> Parts:
    """Build all that a run of `nerf train` is made of, and read its scene; nothing is written.

    Args:
        config: of the run.
        choices: the names picked from each group, which its checkpoints keep.
        overrides: what the config was composed with.
        former: the config of the run that is gone on with, as its folder keeps it; None: it is a new one.

    Raises:
        InputError: anything in the config or in the capture that makes no run.
    """
    settings: TrainerSettings = build(config.trainer)
    settings.prepare_machine()
    finish, loggers = Finish.from_config(config), build(config.logger)
    for each in loggers.values() if ranks.is_first() else ():
        if isinstance(each, WeightsAndBiases):
            each.require_access()
    scene: Scene = build(config.scene).read()
    finish.require_film(scene)
    config, choices = settled(config, choices, overrides, scene)
    checks = ranks.from_first(lambda: require_sound(scene)) if config.doctor else None
    config, choices = corrected(config, choices, overrides, checks, former)
    run = _run(config, choices, settings, scene)
    num_rays, data = run.data.batches.whole.num_rays, config.data
    num_steps = settings.num_steps(num_rays, data.batch_rays, data.crop_steps)
    signals, clock = StopSignals(), TrainingTime()
    callbacks: list[Callback] = [signals, clock, FolderGuard(), *_chosen_callbacks(config)]
    if "live_view" in config.viewer:
        callbacks.append(build(config.viewer.live_view))
    if config.budget.seconds is not None:
        callbacks.append(TimeBudget(float(config.budget.seconds)))
    # Checkpoints come last, so that they save what the others left.
    callbacks.sort(key=lambda callback: isinstance(callback, Checkpoints))
    return Parts(
        **vars(run),
        config=config,
        checks=checks,
        num_steps=num_steps,
        signals=signals,
        clock=clock,
        callbacks=callbacks,
        loggers=loggers,
        finish=finish,
    )


def _run(
    config: DictConfig,
    choices: Mapping[str, Any],
    settings: TrainerSettings,
    scene: Scene,
    model: Model | None = None,
    loss: Loss | None = None,
) -> Run:
    text = yaml.safe_dump(OmegaConf.to_container(config, resolve=True), sort_keys=False)
    record = make_record(scene, text, chosen(choices))
    record["pixels"] = ranks.from_first(lambda: photograph_hashes(scene.pixels))
    progress = Progress()
    start = None
    if config.init_from is not None:
        start = read_checkpoint(required_path("init_from", config.init_from))
    step = build_step(config, settings, scene, progress, start, model, loss)
    if start is not None:
        log.info("init_from: begins with the weights of %s, of step %d", start.path, start.step)
    step.new_optimizer()  # what it refuses is refused before a folder is taken
    data = build(config.data)(scene=scene, progress=progress, seed=config.seed, patch=step.loss.patch)
    if ranks.is_first():
        warn_of_faults(scene)
    return Run(settings, scene, data, RadianceFieldSystem(step, record, config.resume_changed_capture))


def _chosen_callbacks(config: DictConfig) -> list[Callback]:
    chosen = build(config.callbacks)
    for name, callback in chosen.items():
        if not isinstance(callback, Callback):
            raise InputError(f"callbacks.{name}={callback} is no callback. To do without one, add ~callbacks.{name}.")
    return list(chosen.values())


def build_step(
    config: DictConfig,
    settings: TrainerSettings,
    scene: Scene,
    progress: Progress,
    start: Checkpoint | None = None,
    model: Model | None = None,
    loss: Loss | None = None,
) -> TrainStep:
    """Build model, cameras, loss, correction, optimizer and schedule into the step of training.

    Args:
        config: of the run.
        settings: of the machine.
        scene: what is learnt.
        progress: the run's place.
        start: the checkpoint whose weights it begins with.
        model: one in the place of the config's.
        loss: the same.

    Raises:
        InputError: a value of the wrong kind, cameras that cannot be refined, a model that cannot be cut into tiles, a
            correction for one photograph.
    """
    if not isinstance(config.seed, int):
        raise InputError(f"seed={config.seed} does not fit: it must be a whole number.")
    model = build(config.model) if model is None else model
    refinement: Refinement = build(config.refinement)
    refinement.fit_to(scene)
    if model.needs_photographs and refinement.moves():
        raise InputError(
            "A model that looks at photographs takes their cameras as they are, so nothing is learnt of them: leave "
            "refinement out. Refine the cameras of a capture with a model of its own (model=fast)."
        )
    scene = replace(scene, refined=refinement.moves())
    optimizer = build(config.optimizer)
    if settings.device_type == "xla":
        xla.require_static_shapes(model)
        optimizer.keywords.pop("fused", None)  # torch's own fusion is for other devices; XLA fuses by itself
    hold_to_budgets(model, "The model")
    model.fit_to(scene)
    show_photographs(model, scene)
    correction: Correction = build(config.correction)
    correction.fit_to(scene)
    if start is not None:
        load_weights(model, start)
    return TrainStep(
        model=model,
        rays=RayGenerator.of_views(scene, model, refinement),
        loss=build(config.loss) if loss is None else loss,
        correction=correction,
        optimizer=optimizer,
        schedule=build(config.scheduler),
        progress=progress,
        seed=config.seed,
        background=scene.background,
        tile_points=settings.tile_points,
        clip_norm=settings.clip_norm,
        sample_budget=config.data.sample_budget,
        start_weights=None if start is None else start.weights,
        jitter=config.data.overfit_views is None,
    )

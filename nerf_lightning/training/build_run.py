"""What a run is made of, from its config: scene, data, system."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.checkpoints.reading import make_record, read_checkpoint
from nerf_lightning.compute import ranks
from nerf_lightning.config.auto_settings import resolve_auto, resolve_correction
from nerf_lightning.config.compose import chosen, compose_config
from nerf_lightning.config.instantiate import build, required_path
from nerf_lightning.config.overrides import key_of
from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.data.pixels.decoding import photograph_hashes
from nerf_lightning.files.budgets import Budgets, set_limits
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.losses.base import Loss
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.nerf.types.scene import Scene
from nerf_lightning.training.build_step import build_step
from nerf_lightning.training.launch.trainer import TrainerSettings
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
    set_limits(Budgets(**config.budgets))
    settings: TrainerSettings = build(config.trainer)
    settings.prepare_machine()
    scene: Scene = build(config.scene).read()
    config, choices = resolve_auto(config, choices, overrides, scene, settings.device_type == "cuda")
    config, choices = resolve_correction(config, choices, overrides)
    run = assemble(config, choices, settings, scene, model, loss)
    settings.prepare(run.system.model)
    run.system.record["precision"] = settings.precision
    return run


def _refuse_settings_of_the_trainer(overrides: Sequence[str]) -> None:
    for override in overrides:
        key = key_of(override)
        for setting, instead in OF_LIGHTNINGS_TRAINER.items():
            if key == setting or key.startswith((f"{setting}.", f"{setting}@")):
                raise InputError(f"{override}: this is for Lightning's Trainer to say here: {instead}.")


def assemble(
    config: DictConfig,
    choices: Mapping[str, Any],
    settings: TrainerSettings,
    scene: Scene,
    model: Model | None = None,
    loss: Loss | None = None,
) -> Run:
    """Put a run together from a config in which nothing is left open.

    Args:
        config: of the run.
        choices: the names picked from each group, which its checkpoints keep.
        settings: of the machine.
        scene: what is learnt.
        model: one in the place of the config's.
        loss: the same.
    """
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
    data = build(config.data)(
        scene=scene, progress=progress, seed=config.seed, patch=step.loss.patch, depth_every=step.loss.depth_every
    )
    if ranks.is_first():
        build(config.quick_checks)(scene)
    return Run(settings, scene, data, RadianceFieldSystem(step, record, config.resume_changed_capture))

"""What a run is made of, from its config: scene, data, system."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.checkpoints.reading import make_record, read_checkpoint
from nerf_lightning.checkpoints.same_capture import depth_sums
from nerf_lightning.compute import ranks
from nerf_lightning.config.compose import chosen
from nerf_lightning.config.instantiate import build, required_path
from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.data.pixels.decoded_photographs import photograph_hashes
from nerf_lightning.nerf.losses.base import Loss
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.nerf.types.scene import Scene
from nerf_lightning.training.build_step import build_step
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.system import RadianceFieldSystem

log = logging.getLogger(__name__)


@dataclass
class Run:
    """What learns, and from what."""

    settings: TrainerSettings
    scene: Scene
    data: RayDataModule
    system: RadianceFieldSystem


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
        scene: what is learned.
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
    train_step = build_step(config, settings, scene, progress, start, model, loss)
    if start is not None:
        log.info("init_from: starting from the weights of %s, step %d", start.path, start.step)
    loss = train_step.objective.loss
    if loss.depth_every:
        record["depths"] = depth_sums(scene)
    train_step.new_optimizer()  # what it refuses is refused before a folder is taken
    data = build(config.data)(
        scene=scene, progress=progress, seed=config.seed, patch=loss.patch, depth_every=loss.depth_every
    )
    if ranks.is_first():
        build(config.quick_checks)(scene)
    return Run(settings, scene, data, RadianceFieldSystem(train_step, record, config.resume_changed_capture))

"""Plan a run: read its scene, choose what its config leaves open, and build what learns.

`nerf train`, `nl.train` and `nl.build_run` all plan their runs here.
"""

import logging
from dataclasses import dataclass

import yaml
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.checkpoints.record import make_record
from nerf_lightning.checkpoints.same_capture import depth_sums
from nerf_lightning.compute import ranks
from nerf_lightning.config.auto_settings import resolve_auto, resolve_correction, takes_distances, with_longest
from nerf_lightning.config.compose import Composed
from nerf_lightning.config.instantiate import build, required_path
from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.data.pixels.decoded_photographs import photograph_hashes
from nerf_lightning.doctor.check import Check
from nerf_lightning.doctor.gate import exposure_finding, require_sound
from nerf_lightning.doctor.triangulation import with_distances
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
    """What is trained, and on what."""

    config: DictConfig
    """The complete config: nothing is left open."""
    settings: TrainerSettings
    scene: Scene
    checks: list[Check] | None
    """The doctor's findings about the scene; None: `doctor=false`."""
    data: RayDataModule
    system: RadianceFieldSystem


def plan_run(
    requested: Composed,
    settings: TrainerSettings,
    scene: Scene | None = None,
    model: Model | None = None,
    loss: Loss | None = None,
) -> Run:
    """Read the scene, choose what the config leaves open, examine the capture, and build; nothing is written.

    Args:
        requested: the config of `nerf train`; checkpoints keep what was picked from each group.
        settings: of the machine.
        scene: replaces the config's.
        model: replaces the config's.
        loss: replaces the config's.

    Raises:
        InputError: the config or the capture does not allow a run.
    """
    requested, scene = read_scene(requested, settings.device_type == "cuda", scene)
    planned = resolve_auto(requested, scene, settings.device_type)
    settings.max_steps = planned.config.trainer.max_steps
    checks = ranks.from_first(lambda: require_sound(scene)) if planned.config.doctor else None
    planned = resolve_correction(planned, exposure_finding(checks))
    data, system = _built(planned, settings, scene, model, loss)
    return Run(planned.config, settings, scene, checks, data, system)


def read_scene(requested: Composed, on_gpu: bool, scene: Scene | None = None) -> tuple[Composed, Scene]:
    """Return the config with the size of the photographs, and the scene, with distances if the loss needs them."""
    requested = with_longest(requested, on_gpu)
    scene = build(requested.config.scene).read() if scene is None else scene
    return requested, with_distances(scene) if takes_distances(requested, scene) else scene


def _built(
    planned: Composed, settings: TrainerSettings, scene: Scene, model: Model | None, loss: Loss | None
) -> tuple[RayDataModule, RadianceFieldSystem]:
    config = planned.config
    text = yaml.safe_dump(OmegaConf.to_container(config, resolve=True), sort_keys=False)
    record = make_record(scene, text, dict(planned.choices))
    record["pixels"] = ranks.from_first(lambda: photograph_hashes(scene.pixels))
    progress = Progress()
    start = None
    if config.init_from is not None:
        start = read_checkpoint(required_path("init_from", config.init_from))
    loss = build(config.loss) if loss is None else loss
    # Before kernels are compiled: its settings may be refused.
    data = build(config.data)(
        scene=scene, progress=progress, seed=config.seed, patch=loss.patch, depth_every=loss.depth_every
    )
    train_step = build_step(config, settings, scene, progress, start, model, loss)
    if start is not None:
        log.info("init_from: starting from the weights of %s, step %d", start.path, start.step)
    if loss.depth_every:
        record["depths"] = depth_sums(scene)
    train_step.new_optimizer()  # its errors occur before a folder is taken
    if ranks.is_first():
        build(config.quick_checks)(scene)
    return data, RadianceFieldSystem(train_step, record, config.resume_changed_capture)

"""What a run is made of, from its config: scene, data, system, callbacks, and what follows."""

from dataclasses import dataclass

import yaml
from hydra.core.hydra_config import HydraConfig
from lightning.pytorch import Callback
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.checkpoints.reading import Checkpoint, make_record, read_checkpoint
from nerf_lightning.config.instantiate import build, required_path
from nerf_lightning.config.load_model import hold_to_budgets, load_weights
from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.errors import InputError
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.nerf.types.scene import Scene
from nerf_lightning.training.callbacks.checkpoints import Checkpoints
from nerf_lightning.training.callbacks.folder_guard import FolderGuard
from nerf_lightning.training.callbacks.stop_signals import StopSignals
from nerf_lightning.training.callbacks.time_budget import TimeBudget
from nerf_lightning.training.evaluate_and_film import Finish
from nerf_lightning.training.launch import xla
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.step import TrainStep
from nerf_lightning.training.system import RadianceFieldSystem


@dataclass
class Parts:
    """Everything that a run is made of, but for its place on the disk."""

    settings: TrainerSettings
    scene: Scene
    num_steps: int
    data: RayDataModule
    system: RadianceFieldSystem
    signals: StopSignals
    callbacks: list[Callback]
    finish: Finish


def build_parts(config: DictConfig) -> Parts:
    """Build all that a run is made of, and read its scene; nothing is written.

    Raises:
        InputError: anything in the config or in the capture that makes no run.
    """
    settings: TrainerSettings = build(config.trainer)
    settings.prepare_machine()
    finish = Finish.from_config(config)
    scene: Scene = build(config.scene).read()
    finish.require_film(scene)
    num_rays = sum(int(scene.pixels.width[v] * scene.pixels.height[v]) for v in scene.splits["train"])
    num_steps = settings.num_steps(num_rays, config.data.batch_rays, config.data.crop_steps)
    choices = {key: value for key, value in HydraConfig.get().runtime.choices.items() if isinstance(value, str)}
    text = yaml.safe_dump(OmegaConf.to_container(config, resolve=True), sort_keys=False)
    progress = Progress()
    record = make_record(scene, text, choices)
    start = None
    if config.init_from is not None:
        start = read_checkpoint(required_path("init_from", config.init_from))
    step = build_step(config, settings, scene, progress, num_steps, start)
    step.new_optimizer()  # what it refuses is refused before a folder is taken
    data = build(config.data)(scene=scene, progress=progress, seed=config.seed, num_steps=num_steps)
    signals = StopSignals()
    callbacks: list[Callback] = [signals, FolderGuard(), *_chosen_callbacks(config)]
    if "live_view" in config.viewer:
        callbacks.append(build(config.viewer.live_view))
    if config.budget.seconds is not None:
        callbacks.append(TimeBudget(float(config.budget.seconds)))
    # Checkpoints come last, so that they save what the others left.
    callbacks.sort(key=lambda callback: isinstance(callback, Checkpoints))
    return Parts(settings, scene, num_steps, data, RadianceFieldSystem(step, record), signals, callbacks, finish)


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
    num_steps: int,
    start: Checkpoint | None = None,
) -> TrainStep:
    """Build model, loss, optimizer and schedule into the step of training.

    Raises:
        InputError: a value of the wrong kind, or a model that cannot be cut into tiles.
    """
    if not isinstance(config.seed, int):
        raise InputError(f"seed={config.seed} does not fit: it must be a whole number.")
    model: Model = build(config.model)
    optimizer = build(config.optimizer)
    if settings.device_type == "xla":
        xla.require_static_shapes(model)
        optimizer.keywords.pop("fused", None)  # torch's own fusion is for other devices; XLA fuses by itself
    hold_to_budgets(model, "The model")
    model.fit_to(scene)
    if start is not None:
        load_weights(model, start)
    return TrainStep(
        model=model,
        rays=RayGenerator(scene.cameras, scene.near, scene.far),
        loss=build(config.loss),
        optimizer=optimizer,
        schedule=build(config.scheduler),
        progress=progress,
        num_steps=num_steps,
        seed=config.seed,
        background=scene.background,
        tile_points=settings.tile_points,
        clip_norm=settings.clip_norm,
        sample_budget=config.data.sample_budget,
        start_weights=None if start is None else start.weights,
    )

"""The system of a run, from its config."""

from typing import Any

from omegaconf import DictConfig

from nerf_lightning.config.instantiate import build
from nerf_lightning.config.load_model import hold_to_budgets
from nerf_lightning.errors import InputError
from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.nerf.types.scene import Scene
from nerf_lightning.training.launch import xla
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.system import RadianceFieldSystem


def build_system(
    config: DictConfig,
    settings: TrainerSettings,
    scene: Scene,
    progress: Progress,
    num_steps: int,
    record: dict[str, Any],
) -> RadianceFieldSystem:
    """Build model, loss, optimizer and schedule into the system.

    Raises:
        InputError: a value of the wrong kind, or a model that cannot be cut into tiles.
    """
    if not isinstance(config.seed, int):
        raise InputError(f"seed={config.seed} does not fit: it must be a whole number.")
    model: RadianceModel = build(config.model)
    optimizer = build(config.optimizer)
    if settings.device_type == "xla":
        xla.require_static_shapes(model)
        optimizer.keywords.pop("fused", None)  # torch's own fusion is for other devices; XLA fuses by itself
    hold_to_budgets(model, "The model")
    model.fit_to(scene)
    return RadianceFieldSystem(
        model=model,
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
        record=record,
    )

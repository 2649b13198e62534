"""Build the training step from a config: model, cameras, loss, correction, optimizer and schedule."""

from dataclasses import replace

from omegaconf import DictConfig

from nerf_lightning.checkpoints.reading import Checkpoint
from nerf_lightning.compute import ranks
from nerf_lightning.compute.compile_kernels import compile_kernels
from nerf_lightning.config.instantiate import build
from nerf_lightning.config.load_model import hold_to_budgets
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.corrections.base import Correction, NoCorrection
from nerf_lightning.nerf.kernels.backends import CPU_BACKENDS, KERNELS
from nerf_lightning.nerf.losses.base import Loss
from nerf_lightning.nerf.models.base import Model, show_photographs
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.objective import Objective
from nerf_lightning.nerf.part import fit_parts
from nerf_lightning.nerf.refinements.base import Refinement
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.nerf.types.scene import Scene
from nerf_lightning.training.attempts import draw_weights
from nerf_lightning.training.launch import xla
from nerf_lightning.training.launch.fitting import require_deterministic, require_one_process
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.step import TrainStep


def build_step(
    config: DictConfig,
    settings: TrainerSettings,
    scene: Scene,
    progress: Progress,
    start: Checkpoint | None = None,
    model: Model | None = None,
    loss: Loss | None = None,
) -> TrainStep:
    """Return the training step, built of model, cameras, loss, correction, optimizer and schedule.

    Args:
        config: the run's config.
        settings: the trainer's settings.
        scene: the scene to learn.
        progress: the run's progress.
        start: the checkpoint whose weights the run begins with.
        model: replaces the config's.
        loss: replaces the config's.

    Raises:
        InputError: a value of the wrong kind, cameras that cannot be refined, a model that cannot be tiled, a
            correction for one photograph, several processes for a part that depends on all rays of a step.
    """
    if not isinstance(config.seed, int):
        raise InputError(f"seed={config.seed} does not fit: it must be a whole number.")
    model = build(config.model) if model is None else model
    refinement: Refinement = build(config.refinement)
    refinement.fit_to(scene)
    if model.needs_photographs and refinement.moves():
        raise InputError(
            "A model that looks at photographs takes their cameras as they are, so nothing is learned of them: leave "
            "refinement out. Refine the cameras of a capture with a model of its own (model=fast)."
        )
    scene = replace(scene, refined=refinement.moves())
    optimizer = build(config.optimizer)
    if settings.device_type == "xla":
        xla.require_static_shapes(model)
        optimizer.keywords.pop("fused", None)  # torch's fused optimizers are for other devices; XLA fuses by itself
    if settings.deterministic:
        require_deterministic(model, settings.device_type)
    hold_to_budgets(model, "The model")
    if settings.device_type == "cpu":
        taken = model.kernels()
        compile_kernels([f"{KERNELS}.{name}" for name in CPU_BACKENDS if name in taken])
    fit_parts(model, scene)
    show_photographs(model, scene)
    correction: Correction = build(config.correction)
    correction.fit_to(scene)
    if start is not None:
        start.load_weights(model)
    loss = build(config.loss) if loss is None else loss
    corrects, refines = not isinstance(correction, NoCorrection), refinement.moves()
    rays = RayGenerator.of_views(scene, model.needs_photographs, refinement if refines else None)
    train_step = TrainStep(
        objective=Objective(model, rays, loss, scene.background, correction if corrects else None),
        optimizer=optimizer,
        schedule=build(config.scheduler),
        progress=progress,
        seed=config.seed,
        tile_points=settings.tile_points,
        clip_norm=settings.clip_norm,
        sample_budget=config.data.sample_budget,
        start_weights=None if start is None else start.weights,
        jitter=config.data.overfit_views is None,
        records=settings.records_there,
    )
    require_one_process(train_step, ranks.world_size())
    if train_step.tiles.takes_whole_batches:
        settings.take_whole_batches()
    draw_weights(train_step)
    return train_step

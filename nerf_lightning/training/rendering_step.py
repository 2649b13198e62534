"""A training step for a finished checkpoint, which renders and validates but does not train."""

from collections.abc import Sequence
from typing import NoReturn

from nerf_lightning.checkpoints.reading import Checkpoint
from nerf_lightning.compute.settings import ComputeSettings
from nerf_lightning.config.load_model import load_model
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.losses.mse import MeanSquaredError
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.objective import Objective
from nerf_lightning.nerf.optimizers.schedule import ExponentialDecay
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.training.step import TrainStep


def rendering_step(checkpoint: Checkpoint, trusted: Sequence[str] = ()) -> TrainStep:
    """Return a training step that renders and validates but does not train.

    A run's loss, optimizer and schedule come only from the user's own config, never from a file.
    """

    def no_optimizer(parameters: object) -> NoReturn:
        raise InputError(
            f"This system was loaded from a checkpoint ({checkpoint.path}), which holds neither the photographs nor "
            "how it was trained, so it only renders. To go on training: run = build_run(...) with the settings of the "
            f"run, then trainer.fit(run.system, run.data, ckpt_path='{checkpoint.path}')."
        )

    scene, model, settings = checkpoint.scene, load_model(checkpoint, trusted), ComputeSettings(accelerator="cpu")
    settings.keep_tile(checkpoint.tile_points)
    return TrainStep(
        objective=Objective(
            model, RayGenerator.of_views(scene, model.needs_photographs), MeanSquaredError(), scene.background
        ),
        optimizer=no_optimizer,
        schedule=ExponentialDecay(),
        progress=Progress(),
        seed=0,
        tile_points=settings.tile_points,
    )

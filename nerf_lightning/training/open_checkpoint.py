"""A checkpoint on its way to be looked at: the device is chosen, the file read, its model built and prepared."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from omegaconf import DictConfig

from nerf_lightning.checkpoints.reading import Checkpoint, read_checkpoint
from nerf_lightning.config.instantiate import build, required_path
from nerf_lightning.config.load_model import load_model
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.training.launch.trainer import TrainerSettings


@dataclass(frozen=True)
class Opened:
    """What a command needs of a checkpoint."""

    settings: TrainerSettings
    checkpoint: Checkpoint
    model: Model

    @property
    def tile_points(self) -> int:
        """So many points at most are asked about at once."""
        return self.settings.inference_tile_points


def open_checkpoint(config: DictConfig, float32: bool = False) -> Opened:
    """Open `ckpt` as the config's trainer says.

    Args:
        config: of a command, with `ckpt` and `trainer`.
        float32: multiply so, whatever the run was trained in.

    Raises:
        InputError: it cannot be read, or is no checkpoint of this program.
    """
    return open_checkpoints(config, [config.ckpt], float32)[0]


def open_checkpoints(config: DictConfig, paths: Sequence[Any], float32: bool = False) -> list[Opened]:
    """Open several; the tiles are those of the first."""
    settings: TrainerSettings = build(config.trainer)
    settings.prepare_machine()
    checkpoints = [read_checkpoint(required_path("ckpt", path)) for path in paths]
    settings.keep_tile(checkpoints[0].tile_points)
    return [Opened(settings, each, _model(settings, each, float32)) for each in checkpoints]


def _model(settings: TrainerSettings, checkpoint: Checkpoint, float32: bool) -> Model:
    model = load_model(checkpoint)
    return model.to(settings.device) if float32 else settings.prepare(model)

"""Open a checkpoint: choose the device, read the file, build and prepare its model.

Which file of a run folder is read, and what is said if there is none: `checkpoints/reading.py`.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from omegaconf import DictConfig

from nerf_lightning.checkpoints.reading import Checkpoint, read_checkpoint
from nerf_lightning.checkpoints.recorded_frame import as_trained
from nerf_lightning.compute.settings import ComputeSettings
from nerf_lightning.config.compose import compose_config
from nerf_lightning.config.instantiate import build, required_path
from nerf_lightning.config.load_model import load_model
from nerf_lightning.config.overrides import quoted
from nerf_lightning.config.scene_overrides import scene_overrides
from nerf_lightning.data.captures.joined import shown_capture
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.models.base import Model, show_photographs
from nerf_lightning.nerf.types.scene import Scene

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LoadedModel:
    """What a command needs from a checkpoint."""

    settings: ComputeSettings
    checkpoint: Checkpoint
    model: Model
    trusted: Sequence[str] = ()
    """The user's own modules, whose classes may be built."""

    @property
    def tile_points(self) -> int:
        """Maximum number of points evaluated at once."""
        return self.settings.inference_tile_points


def open_checkpoint(config: DictConfig, float32: bool = False) -> LoadedModel:
    """Open `ckpt` according to the config's `trainer` and `trust`; `float32`: overrides the training precision.

    Raises:
        InputError: it cannot be read, or is not a checkpoint of this program.
    """
    return open_checkpoints(config, [config.ckpt], float32)[0]


def open_checkpoints(config: DictConfig, paths: Sequence[Any], float32: bool = False) -> list[LoadedModel]:
    """Open several checkpoints; the tile size is that of the first."""
    settings: ComputeSettings = build(config.trainer)
    settings.prepare_machine()
    trusted = trusted_modules(config.trust)
    checkpoints = [read_checkpoint(required_path("ckpt", path)) for path in paths]
    settings.keep_tile(checkpoints[0].tile_points)
    models = (load_model(each, trusted) for each in checkpoints)
    ready = [model.to(settings.device) if float32 else settings.prepare(model) for model in models]
    return [LoadedModel(settings, *each, trusted) for each in zip(checkpoints, ready, strict=True)]


def trusted_modules(trust: Any) -> list[str]:
    """Return the modules that `trust` names."""
    named = [] if trust is None else [trust] if isinstance(trust, str) else list(trust)
    for name in named:
        if not isinstance(name, str) or not all(word.isidentifier() for word in name.split(".")):
            raise InputError(f"trust={name}: give the name of a Python module of your own, such as my_parts.")
    return named


def scene_to_look_at(opened: LoadedModel, scene: DictConfig | None) -> Scene:
    """Give a model that renders from photographs those of a scene (None: of its run), and return the scene."""
    if scene is None:
        path = str(opened.checkpoint.path)
        scene = compose_config("eval", [f"ckpt={quoted(path)}", *scene_overrides(path)]).config.scene
    shown = shown_capture(build(scene).read())
    show_photographs(opened.model, shown)
    return shown


def as_known(scene: Scene, opened: LoadedModel) -> Scene:
    """Return a scene in the frame that an opened model was trained in, if it was trained in one.

    Raises:
        InputError: the model was trained in another kind of space.
    """
    return scene if opened.model.needs_photographs else as_trained(scene, opened.checkpoint)


def read_photographs(config: DictConfig, opened: LoadedModel) -> Scene | None:
    """Return the capture that `scene` names, as the checkpoint's model knows it.

    If it cannot be read, warn and return None.
    """
    try:
        return as_known(build(config.scene).read(), opened)
    except (InputError, OSError) as error:
        log.warning("The photographs cannot be read and are left out: %s", error)
        return None

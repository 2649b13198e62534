"""Render a film (video) along a camera path.

Its settings: `conf/render.yaml`; the camera path's: `conf/path/`; codecs: `video/encoding.py`.
"""

from dataclasses import replace
from typing import Any, cast

import torch
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.checkpoints.reading import Checkpoint
from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.config.instantiate import build
from nerf_lightning.config.open_checkpoint import LoadedModel, open_checkpoints, scene_to_look_at
from nerf_lightning.data.captures.checks import known_background
from nerf_lightning.messages.console import say_written
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.types.scene import SceneRecord
from nerf_lightning.runs.command_folder import beside_checkpoint, filled_folder
from nerf_lightning.training.launch.processes import on_all_processes
from nerf_lightning.video.film import film
from nerf_lightning.video.settings import as_list, film_settings
from nerf_lightning.video.shots import Subject


def run(config: DictConfig) -> None:
    """Render color and depth."""
    on_all_processes("render", config, render)


def render(config: DictConfig) -> None:
    """Film one checkpoint, or several side by side; only models of many scenes need more than their checkpoints."""
    plain = cast(dict[str, Any], OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
    shown = film_settings(plain)
    path = build(config.path)
    opened = open_checkpoints(config, as_list(plain["ckpt"]))
    labels = labels_of([each.checkpoint for each in opened], plain["labels"])
    scenes = [_scene(each, config.get("scene")) for each in opened]
    subjects = [
        Subject(each.model, scene, known_background(config.background or scene.background), label)
        for each, scene, label in zip(opened, scenes, labels, strict=True)
    ]
    first = opened[0]
    shown = replace(shown, precision=first.settings.precision)
    default = beside_checkpoint(first.checkpoint.path, "render")
    with torch.no_grad(), filled_folder(config.paths.output_dir, default) as folder:
        written = film(subjects, path, first.tile_points, folder, shown)
    say_written(*written)


def _scene(opened: LoadedModel, scene: DictConfig | None) -> SceneRecord:
    """Return the scene that a model renders: its own, or, for models that render from photographs, the named one."""
    if opened.model.needs_photographs:
        return scene_record(scene_to_look_at(opened, scene))
    if scene is not None:
        raise InputError(
            f"{opened.checkpoint.path} can render only its own scene, {opened.checkpoint.scene.name}. Leave out "
            "scene=...: only models that use photographs render other scenes."
        )
    return opened.checkpoint.scene


def labels_of(checkpoints: list[Checkpoint], labels: Any) -> list[str]:
    """Return labels for checkpoints shown side by side: as given, or else from their run folders."""
    if labels is None:
        paths = [checkpoint.path.absolute() for checkpoint in checkpoints]
        names = [path.parents[1].name if path.parent.name == "checkpoints" else path.stem for path in paths]
        twice = len(set(names)) < len(names)
        return [f"{name} {each.path.stem}" if twice else name for name, each in zip(names, checkpoints, strict=True)]
    labels = list(map(str, as_list(labels)))
    if len(labels) != len(checkpoints):
        raise InputError(f"labels={labels}: give one for each of the {len(checkpoints)} checkpoints, or null.")
    return labels

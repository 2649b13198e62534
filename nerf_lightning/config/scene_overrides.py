"""The scene that a checkpoint was trained on, as overrides for our own conf/."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.config.overrides import quoted
from nerf_lightning.errors import InputError
from nerf_lightning.files.folders import conf_folder
from nerf_lightning.files.yaml_files import plain_yaml, read_plain_yaml

# Settings of scenes that say where a capture lies.
PLACES = ("root", "path")
# Settings that say where to write, what to fetch and how far to trust: the user's alone.
OF_THE_USER = ("download", "cache_dir", "allow_outside", "max_gigabytes")


class UnknownScene(InputError):
    """Report a checkpoint that is sound, but does not say what it was trained on."""


def scene_overrides(path: str) -> list[str]:
    """Return `scene=NAME` and the recorded plain values that our yaml of this name knows.

    A relative place that is not found from here is taken from where the run was started, if its folder still says.

    Raises:
        UnknownScene: it was trained on a scene that our conf/ lacks.
        InputError: the checkpoint cannot be read.
    """
    checkpoint = read_checkpoint(path.strip("'\""))
    name = checkpoint.choices.get("scene", "")
    known = {file.stem: file for file in (conf_folder() / "scene").glob("*.yaml")}
    if name not in known:
        raise UnknownScene(
            f"{path} was trained on the scene '{name}', which conf/scene/ lacks. Name the scene: "
            f"add scene=... ({', '.join(sorted(known))})."
        )
    config = plain_yaml(checkpoint.config, f"The config in {path}")
    recorded = config.get("scene") if isinstance(config, dict) else None
    if not isinstance(recorded, dict):
        raise UnknownScene(f"{path} is damaged: its config has no readable scene part. Name the scene with scene=...")
    ours = yaml.safe_load(known[name].read_text(encoding="utf-8"))
    values = dict(_plain_values(recorded, ours))
    values |= {key: _found(values[key], checkpoint.path) for key in PLACES if isinstance(values.get(key), str)}
    if ours.get("download") and not os.path.exists(str(values.get("path"))):
        values.pop("path", None)  # what is fetched lies where our yaml says, not where a stranger's file does
    return [f"scene={name}", *(f"scene.{key}={quoted(value)}" for key, value in values.items())]


def _plain_values(recorded: dict[str, Any], ours: dict[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield what may be taken from a file: plain values of settings that we know, but no classes and no addresses."""
    for key, value in recorded.items():
        if key not in ours or key.startswith("_") or key in OF_THE_USER:
            continue
        if isinstance(value, dict) and isinstance(ours[key], dict):
            yield from _plain_values(value, ours[key], f"{path}{key}.")
        elif value is None or isinstance(value, (bool, int, float, str)):
            yield f"{path}{key}", value


def _found(place: str, checkpoint: Path) -> str:
    try:
        if Path(place).expanduser().is_absolute() or Path(place).exists():
            return place
        note = read_plain_yaml(checkpoint.parent.parent / ".hydra" / "hydra.yaml")
        there = Path(note["runtime"]["cwd"]) / place
        return str(there) if there.exists() else place
    except (OSError, RuntimeError, ValueError, TypeError, KeyError, InputError):
        return place

"""The training scene of a checkpoint, as overrides for our own conf/."""

import logging
import os
from pathlib import Path
from typing import Any

import yaml

from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.config.overrides import leaves, quoted
from nerf_lightning.config.setting_rules import PLACES, Trust, meaning_of, names_a_class
from nerf_lightning.files.folders import conf_file, option_names
from nerf_lightning.files.yaml_files import plain_yaml, read_plain_yaml
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import for_terminal, listed

log = logging.getLogger(__name__)


class UnknownScene(InputError):
    """A checkpoint is sound, but does not say what it was trained on."""


def scene_overrides(path: str) -> list[str]:
    """Return `scene=NAME` and the recorded plain values that our YAML of this name has and a file may choose.

    A relative path that does not exist here is resolved from where the run was started, if its folder still says so.

    Raises:
        UnknownScene: its training scene is not in our conf/.
        InputError: the checkpoint cannot be read.
    """
    checkpoint = read_checkpoint(path)
    name = checkpoint.choices.get("scene", "")
    known = option_names("scene")
    if name not in known:
        raise UnknownScene(
            f"{path} was trained on the scene '{name}', which conf/scene/ lacks. Name the scene: "
            f"add scene=... ({', '.join(known)})."
        )
    config = plain_yaml(checkpoint.config, f"The config in {path}")
    recorded = config.get("scene") if isinstance(config, dict) else None
    if not isinstance(recorded, dict):
        raise UnknownScene(f"{path} is damaged: its config has no readable scene part. Name the scene with scene=...")
    ours = _settings_of(conf_file(f"scene/{name}"))
    values = _taken(leaves(recorded, "scene"), leaves(ours, "scene"), path)
    values |= {key: _resolved_path(values[key], checkpoint.path) for key in PLACES if isinstance(values.get(key), str)}
    if ours.get("download") and not os.path.exists(str(values.get("scene.path"))):
        values.pop("scene.path", None)  # downloads are where our YAML says, not where an untrusted file does
    return [f"scene={name}", *(f"{key}={quoted(value)}" for key, value in values.items())]


def _settings_of(file: Path) -> dict[str, Any]:
    """Return the settings of one of our YAMLs, with those that it includes (`/scene_defaults@_here_`)."""
    content = yaml.safe_load(file.read_text(encoding="utf-8"))
    taken: dict[str, Any] = {}
    for name in content.pop("defaults", []):
        base = name.removeprefix("/").removesuffix("@_here_")
        taken |= _settings_of(conf_file(base))
    return taken | content


def _taken(recorded: dict[str, Any], ours: dict[str, Any], path: str) -> dict[str, Any]:
    """Return what is accepted from a file: plain values of settings that our YAML has and that files may set."""
    taken = {key: value for key, value in recorded.items() if key in ours and _is_taken(key, value)}
    texts_and_numbers = [key for key in ours if isinstance(recorded.get(key), str | float)]
    refused = [key for key in texts_and_numbers if key not in taken and meaning_of(key).trust is Trust.PLAIN]
    refused += [key for key in recorded if key not in ours and not names_a_class(key)]
    if refused:
        log.warning(
            "%s was trained with %s. This program does not know these settings, or they are infinite or lead out of "
            "the capture, so it does not take them from a file. If they are yours, type them.",
            for_terminal(path),
            listed(refused, cap=5),
        )
    return taken


def _is_taken(key: str, value: Any) -> bool:
    return (key in PLACES and isinstance(value, str)) or meaning_of(key).trust.takes(value)


def _resolved_path(path: str, checkpoint: Path) -> str:
    try:
        if Path(path).expanduser().is_absolute() or Path(path).exists():
            return path
        note = read_plain_yaml(checkpoint.parent.parent / ".hydra" / "hydra.yaml")
        there = Path(note["runtime"]["cwd"]) / path
        return str(there) if there.exists() else path
    except (OSError, RuntimeError, ValueError, TypeError, KeyError, InputError):
        return path

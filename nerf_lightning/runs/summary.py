"""Summarize a run folder from `run.json`, `metrics.json` and `.hydra/`."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from nerf_lightning.config.setting_rules import PLACES
from nerf_lightning.files.json_files import number, read_json_object
from nerf_lightning.files.walk import walk
from nerf_lightning.files.yaml_files import read_plain_yaml
from nerf_lightning.messages.errors import InputError

Measured = Literal["run", "eval"]
FILES: dict[Measured, str] = {"run": "metrics.json", "eval": "evaluation/metrics.json"}
CLASS = "._target_"
DECIMAL = re.compile(r"[-+]?(\d+\.\d*|\.\d+|\d+(?=[eE]))([eE][-+]?\d+)?")


@dataclass(frozen=True)
class RunSummary:
    """A run in one row; None if the folder does not say."""

    folder: Path
    overrides: dict[str, str]
    """Overrides from the command line, by key."""
    psnr: float | None
    ssim: float | None
    steps: int | None
    """The step at which the run finished."""
    seconds: float | None
    """Time in training, evaluation and film, of all starts except those that were killed."""
    started: str | None = None
    """When the run began, such as 2026-11-21T10:00:00."""


def read_run(folder: Path) -> RunSummary:
    """Return the summary of a run, finished or not."""
    note, metrics = read_note(folder), read_json_object(folder / "metrics.json")
    steps = number(note.get("finished_at_step"))
    return RunSummary(
        folder=folder,
        overrides=by_key(_read_overrides(folder / ".hydra" / "overrides.yaml")),
        psnr=number(metrics.get("psnr", note.get("psnr"))),
        ssim=number(metrics.get("ssim")),
        steps=None if steps is None else int(steps),
        seconds=number(note.get("seconds")),
        started=str(note["started"]) if "started" in note else None,
    )


def read_note(folder: Path) -> dict[str, Any]:
    """Return the content of `run.json`; empty if it is missing or damaged."""
    return read_json_object(folder / "run.json")


def scene_name(protocol: dict[str, Any], origin: dict[str, Any], overrides: dict[str, str]) -> str:
    """Return the scene's name; if that is only its format's, the name of its folder or file."""
    name = str(protocol.get("scene", "")) or "not said"
    if name != str(origin.get("scene", overrides.get("scene"))):
        return name
    root, *files = (Path(overrides.get(key, "").strip("'\"")) for key in PLACES)
    return root.name or next((file.stem for file in files if file.stem), name)


def scene_of_run(name: str, folder: Path) -> str:
    """Return the name of the scene that a run trains on, whose record is called `name`."""
    return scene_name({"scene": name}, choices_of_run(folder), read_run(folder).overrides)


def choices_of_run(folder: Path) -> dict[str, Any]:
    """Return the picked scene and model, for results that do not name them."""
    try:
        choices = read_plain_yaml(folder / ".hydra" / "hydra.yaml")["runtime"]["choices"]
        return {key: choices[key] for key in ("scene", "model")}
    except (InputError, LookupError, TypeError):
        return {}


def folders_of_runs(root: Path) -> list[Path]:
    """Return the folders below `root`, including itself, that contain a `run.json`."""
    return [folder for folder, _, names in walk(root) if "run.json" in names]


def by_key(overrides: list[str]) -> dict[str, str]:
    """Return overrides as a mapping with numbers in one notation; the last of several values counts.

    >>> by_key(["model=nerf_tiny", "optimizer.lr=2e-2", "seed=0", "seed=1"])
    {'model': 'nerf_tiny', 'optimizer.lr': '0.02', 'seed': '1'}
    """
    pairs = (override.partition("=") for override in overrides)
    return {key: repr(float(value)) if DECIMAL.fullmatch(value) else value for key, _, value in pairs}


def told_settings(overrides: dict[str, str]) -> dict[str, str]:
    """Return overrides by their column names: a class represents its group, and a leading + is dropped.

    >>> told_settings({"loss._target_": "my_losses.L1", "+loss.part": "0.5"})
    {'loss.part': '0.5', 'loss': 'my_losses.L1'}
    """
    given = sorted(overrides.items(), key=lambda pair: pair[0].endswith(CLASS))  # a class takes precedence
    return {key.lstrip("+").removesuffix(CLASS): value for key, value in given}


def differing_keys(settings: Sequence[dict[str, str]]) -> list[str]:
    """Return the keys that are missing or differ in some settings, in the order of their first appearance.

    >>> differing_keys([{"model": "nerf_tiny", "seed": "0"}, {"model": "nerf_tiny", "seed": "1"}])
    ['seed']
    """
    keys = dict.fromkeys(key for given in settings for key in given)
    return [key for key in keys if len({given.get(key) for given in settings}) > 1]


def _read_overrides(path: Path) -> list[str]:
    try:
        content = read_plain_yaml(path)
    except InputError:
        return []
    return [str(override) for override in content] if isinstance(content, list) else []

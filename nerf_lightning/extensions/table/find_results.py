"""Find the results in run folders: metrics, model, scene, and how they were measured."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from nerf_lightning.config.setting_rules import meaning_of
from nerf_lightning.evaluation.metrics_files import METRICS
from nerf_lightning.files.budgets import limits
from nerf_lightning.files.json_files import mapping, number, read_json_object
from nerf_lightning.files.regular import what_is
from nerf_lightning.files.walk import walk
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.runs.summary import (
    FILES,
    Measured,
    RunSummary,
    choices_of_run,
    read_note,
    read_run,
    scene_name,
    told_settings,
)

SEED = re.compile(r"-?\d{1,18}", re.ASCII)


@dataclass(frozen=True)
class RunResult:
    """One measured run."""

    summary: RunSummary
    scene: str
    model: str
    seed: int | None
    values: dict[str, float | None]
    """The mean of each metric, and what else was measured; None if unknown."""
    settings: dict[str, str]
    """Other overrides from the command line."""
    protocol: dict[str, Any]
    origin: dict[str, Any]

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self.summary.folder


@dataclass(frozen=True)
class FoundResults:
    """The results in some folders."""

    file: str
    """Name of the file with each run's numbers."""
    measured: list[RunResult]
    unmeasured: list[Path]
    """Runs without a PSNR in it."""


def find_results(
    folders: Sequence[Path], measured: Measured, scenes: Sequence[str] | None, models: Sequence[str] | None
) -> FoundResults:
    """Return the results of the runs in these folders whose scene and model match a pattern ("lego*"; None: all)."""
    read = {run: read_result(run, measured) for run in find_runs(folders)}
    results = [result for result in read.values() if result is not None]
    if not results:
        raise InputError(
            f"None of the {len(read)} runs has a PSNR in {FILES[measured]}. A run is measured at its end, and "
            "by nerf eval ckpt=RUN/checkpoints/last.ckpt (then with measured=eval)."
        )
    chosen = [result for result in results if _fits(result.scene, scenes) and _fits(result.model, models)]
    if not chosen:
        known = (sorted({getattr(result, key) for result in results}) for key in ("scene", "model"))
        there = " and the models ".join(map(listed, known))
        given = {"scenes": scenes, "models": models}
        asked = " and ".join(f"{key}=[{','.join(names)}]" for key, names in given.items() if names is not None)
        raise InputError(f"No run matches {asked}. The scenes are {there}.")
    return FoundResults(FILES[measured], chosen, [run for run, result in read.items() if result is None])


def _fits(name: str, patterns: Sequence[str] | None) -> bool:
    return patterns is None or any(fnmatchcase(name, pattern) for pattern in patterns)


def find_runs(folders: Sequence[Path]) -> list[Path]:
    """Return the run folders, and the output folders of `nerf eval`, below each of these folders."""
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"runs={folder}: {folder} {what_is(folder)}. Give run folders, or folders that hold some.")
    found = list(dict.fromkeys(run for folder in folders for run in _runs_below(folder)))
    if not found:
        named = ", ".join(map(str, folders))
        raise InputError(f"There is no run in {named} (no run.json and no metrics.json). nerf train leaves some.")
    return found


def _runs_below(folder: Path) -> Iterator[Path]:
    for count, (base, below, names) in enumerate(walk(folder)):
        if count > limits().folders:
            raise InputError(
                f"{folder} holds more than {limits().folders:,} folders. Name the runs more specifically, or add "
                "budgets.folders=N."
            )
        below.sort()
        if "run.json" in names or "metrics.json" in names:
            below.clear()
            yield base


def read_result(folder: Path, measured: Measured) -> RunResult | None:
    """Return the result of a run; None if it was not measured."""
    own = "metrics.json" if not (folder / "run.json").exists() else FILES[measured]
    metrics = read_json_object(folder / own)
    if number(metrics.get("psnr")) is None:
        return None
    run, note = read_run(folder), read_note(folder)
    protocol = mapping(metrics.get("protocol"))
    origin = choices_of_run(folder) | mapping(metrics.get("origin"))
    seed = str(origin.get("seed", run.overrides.get("seed", "0")))
    values = {metric: number(metrics.get(metric)) for metric in METRICS}
    values["frames_per_second"] = number(metrics.get("frames_per_second"))
    values |= {key: number(origin.get(key)) for key in ("parameters", "megabytes")}
    values["steps"] = number(origin.get("step")) if run.steps is None else run.steps
    seconds = number(note.get("training_seconds"))
    values["minutes"] = None if seconds is None else seconds / 60
    # `scene@PACKAGE` picks from the same group as `scene`.
    settings = {k: v for k, v in run.overrides.items() if meaning_of(k.lstrip("+~").partition("@")[0]).has_column}
    return RunResult(
        summary=run,
        scene=scene_name(protocol, origin, run.overrides),
        model=str(origin.get("model") or run.overrides.get("model", "")) or "not said",
        seed=int(seed) if SEED.fullmatch(seed) else None,
        values=values,
        settings=told_settings(settings),
        protocol=protocol,
        origin=origin,
    )

"""Gather measured runs into one table: scene, model, mean and deviation over seeds, beside published numbers."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from omegaconf import DictConfig, ListConfig, OmegaConf

from nerf_lightning.console import say
from nerf_lightning.errors import InputError
from nerf_lightning.escaping import listed
from nerf_lightning.runs.output_folder import output_folder
from nerf_lightning.runs.published import published_for
from nerf_lightning.runs.results import FILES, RunResult, find_runs, read_result
from nerf_lightning.runs.table import (
    ORDERS,
    group_rows,
    group_seeds,
    noted_origins,
    noted_settings,
    one_protocol,
    without_empty,
)
from nerf_lightning.runs.table_files import Row, print_rows, write_rows


@dataclass
class Gathered:
    """What was found."""

    results: list[RunResult]
    unmeasured: list[Path]


def run(config: DictConfig) -> int:
    """Do what the config says; return the number of rows."""
    for key, options in (("measured", tuple(FILES)), ("sort", ORDERS)):
        if config[key] not in options:
            raise InputError(f"{key}={config[key]}: choose one of {', '.join(options)}.")
    folders = [Path(str(folder)) for folder in _listed(config.runs)]
    gathered = _gather(folders, config)
    notes = one_protocol(gathered.results, bool(config.force))
    groups, left_out = group_seeds(gathered.results)
    rows = group_rows(groups, config.sort)
    if config.published:
        rows = _with_published(rows, gathered.results)
    rows = without_empty(rows)
    notes += [*noted_settings(groups), *noted_origins(gathered.results)]
    if left_out:
        notes.append(f"Left out, since newer runs of the same settings and seed are there: {_names(left_out)}.")
    if gathered.unmeasured:
        notes.append(f"Without a PSNR in {FILES[config.measured]}: {listed(gathered.unmeasured, cap=5)}.")
    folder = output_folder(config.paths.output_dir or str(folder_for(folders)), Path())
    write_rows(rows, folder, "table", tuple(notes))
    # A source is longer than a terminal has room for; the files have it.
    short = [
        {key: (value or "").partition(",")[0] if key == "source" else value for key, value in r.items()} for r in rows
    ]
    print_rows(short, "1 run" if len(gathered.results) == 1 else f"{len(gathered.results)} runs")
    say(*notes, f"written to  {folder / 'table.md'} and {folder / 'table.csv'}")
    return len(rows)


def folder_for(folders: Sequence[Path]) -> Path:
    """Return where the table of these folders is written.

    That is the one that holds the others, else the folder that they lie beside each other in; where there is none, or
    it is the root of the disk, the working folder.
    """
    places = [Path(os.path.abspath(folder)) for folder in folders]
    outermost = min(places, key=lambda place: len(place.parts))
    if all(place.is_relative_to(outermost) for place in places):
        return outermost
    beside = outermost.parent
    return beside if beside.name and all(place.parent == beside for place in places) else Path()


def _gather(folders: list[Path], config: DictConfig) -> Gathered:
    read = {run: read_result(run, config.measured) for run in find_runs(folders)}
    measured = [result for result in read.values() if result is not None]
    if not measured:
        raise InputError(
            f"None of the {len(read)} runs has a PSNR in {FILES[config.measured]}. A run is measured at its end, and "
            "by nerf eval ckpt=RUN/checkpoints/last.ckpt (then with measured=eval)."
        )
    chosen = [
        result for result in measured if _fits(result.scene, config.scenes) and _fits(result.model, config.models)
    ]
    if not chosen:
        scenes, models = (sorted({getattr(r, key) for r in measured}) for key in ("scene", "model"))
        raise InputError(
            f"No run fits scenes={config.scenes} and models={config.models}. There are the scenes {listed(scenes)} and "
            f"the models {listed(models)}."
        )
    return Gathered(chosen, [run for run, result in read.items() if result is None])


def _with_published(rows: list[Row], results: Sequence[RunResult]) -> list[Row]:
    """Return the rows with what others have published below those of each scene."""
    reader = {result.scene: str(result.origin.get("scene", "")) for result in results}
    table: list[Row] = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        table += [row for row in rows if row["scene"] == scene]
        table += [
            {
                "scene": scene,
                "model": found.method,
                "PSNR": found.psnr,
                "time": found.time,
                "source": f"published, {found.measured}: {found.source}",
            }
            for found in published_for(scene, reader[scene])
        ]
    return table


def _fits(name: str, patterns: object) -> bool:
    return patterns is None or any(fnmatchcase(name, str(pattern)) for pattern in _listed(patterns))


def _listed(value: object) -> list[object]:
    return list(OmegaConf.to_container(value)) if isinstance(value, ListConfig) else [value]  # type: ignore[arg-type]


def _names(results: Sequence[RunResult]) -> str:
    return listed((str(result.folder) for result in results), cap=5)

"""Gather measured runs into one table: scene, model, mean and deviation over seeds, beside published numbers."""

from pathlib import Path
from typing import Any

from omegaconf import DictConfig, ListConfig

from nerf_lightning.console import say
from nerf_lightning.errors import require_one_of
from nerf_lightning.runs.output_folder import folder_around, output_folder
from nerf_lightning.runs.results import FILES, find_results
from nerf_lightning.runs.table import ORDERS, result_table
from nerf_lightning.runs.table_files import print_rows, write_rows


def run(config: DictConfig) -> int:
    """Do what the config says; return the number of rows."""
    require_one_of(FILES, measured=config.measured)
    require_one_of(ORDERS, sort=config.sort)
    folders = [Path(name) for name in _names(config.runs)]
    scenes, models = (None if names is None else _names(names) for names in (config.scenes, config.models))
    found = find_results(folders, config.measured, scenes, models)
    rows, notes = result_table(found, config.sort, bool(config.published), bool(config.force))
    folder = output_folder(config.paths.output_dir or str(folder_around(folders)), Path())
    write_rows(rows, folder, "table", tuple(notes))
    print_rows(rows, "1 run" if len(found.measured) == 1 else f"{len(found.measured)} runs")
    say(*notes, f"written to  {folder / 'table.md'} and {folder / 'table.csv'}")
    return len(rows)


def _names(value: Any) -> list[str]:
    return list(map(str, value)) if isinstance(value, ListConfig) else [str(value)]

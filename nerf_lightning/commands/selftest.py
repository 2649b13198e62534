"""Say whether this machine computes right: kernels, precisions, trainings, files; a table for a bug report."""

import time
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from nerf_lightning import __version__
from nerf_lightning.config.instantiate import build
from nerf_lightning.console import say
from nerf_lightning.evaluation.protocol import environment
from nerf_lightning.files.json_files import write_json
from nerf_lightning.runs.output_folder import output_folder
from nerf_lightning.selftest.all_checks import bar_of_checks, carry_out, find_checks
from nerf_lightning.selftest.machine import machine
from nerf_lightning.selftest.place import place_for, require_known_device
from nerf_lightning.selftest.table import machine_lines, print_rows
from nerf_lightning.training.launch.trainer import TrainerSettings


def run(config: DictConfig) -> None:
    """Check what the config's trainer chooses, print a table, write selftest.json.

    Raises:
        SystemExit: something is wrong (exit code 1).
    """
    began = time.perf_counter()
    settings: TrainerSettings = build(config.trainer)
    require_known_device(settings)
    folder = output_folder(config.paths.output_dir, Path(config.paths.root_dir) / "selftest")
    with place_for(settings) as place:
        checks = find_checks(place)
        with bar_of_checks(len(checks)) as announce:
            rows = carry_out(checks, announce)
    print_rows(rows, settings.describe(), time.perf_counter() - began)
    known = {"nerf_lightning": __version__} | environment() | machine(settings.device)
    say(*machine_lines(known))
    right = all(row.outcome != "wrong" for row in rows)
    file = folder / "selftest.json"
    result: dict[str, Any] = {"right": right, "device": settings.describe(), "machine": known}
    write_json(file, result | {"checks": [row.as_dict() for row in rows]})
    say(f"written to {file}")
    if not right:
        raise SystemExit(1)

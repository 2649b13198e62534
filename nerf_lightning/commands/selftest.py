"""Say whether this machine computes right: kernels, precisions, trainings, files; a table for a bug report."""

import tempfile
import time
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from nerf_lightning import __version__
from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.config.instantiate import build
from nerf_lightning.config.load_model import load_model
from nerf_lightning.console import StdoutConsole, say, stderr_console
from nerf_lightning.errors import InputError
from nerf_lightning.evaluation.protocol import environment
from nerf_lightning.files.json_files import write_json
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.products import Products
from nerf_lightning.runs.output_folder import output_folder
from nerf_lightning.selftest.all_checks import carry_out, find_checks
from nerf_lightning.selftest.check import Check, Row
from nerf_lightning.selftest.machine import machine
from nerf_lightning.selftest.place import Place
from nerf_lightning.selftest.runs import Runs
from nerf_lightning.selftest.table import machine_lines, remarks, result_table
from nerf_lightning.training.launch.devices import DeviceType, has_tf32
from nerf_lightning.training.launch.trainer import PRODUCTS, TrainerSettings

TRAINERS: dict[DeviceType, str] = {"cpu": "cpu", "cuda": "gpu"}


def run(config: DictConfig) -> None:
    """Check what the config's trainer chooses, print a table, write selftest.json.

    Raises:
        SystemExit: something is wrong (exit code 1).
    """
    began = time.perf_counter()
    settings: TrainerSettings = build(config.trainer)
    if settings.device_type not in TRAINERS:
        raise InputError(
            f"nerf selftest knows CPUs and NVIDIA GPUs, and trainer.accelerator chose {settings.device_type}. Use "
            "trainer=cpu; for TPUs there is make test-xla."
        )
    settings.prepare_machine()
    folder = output_folder(config.paths.output_dir, Path(config.paths.root_dir) / "selftest")
    with tempfile.TemporaryDirectory(prefix="nerf-selftest-") as work:
        place = _place(settings, Path(work))
        try:
            rows = _with_a_bar(find_checks(place))
        finally:
            place.runs.close()
    _print(rows, settings, time.perf_counter() - began)
    known = {"nerf_lightning": __version__} | environment() | machine(settings.device)
    say(*machine_lines(known))
    right = all(row.outcome != "wrong" for row in rows)
    file = folder / "selftest.json"
    result: dict[str, Any] = {"right": right, "device": settings.describe(), "machine": known}
    write_json(file, result | {"checks": [row.as_dict() for row in rows]})
    say(f"written to {file}")
    if not right:
        raise SystemExit(1)


def _place(settings: TrainerSettings, work: Path) -> Place:
    def read_model(path: Path) -> Model:
        return load_model(read_checkpoint(path))

    overrides = [f"trainer={TRAINERS[settings.device_type]}", f"trainer.precision={settings.precision}"]
    return Place(
        device=settings.device,
        products=_products(settings),
        chosen=PRODUCTS[settings.precision],
        compiles=settings.compile or settings.device_type == "cuda",
        runs=Runs(work, overrides),
        read_model=read_model,
    )


def _products(settings: TrainerSettings) -> tuple[Products, ...]:
    return ("float32", "tf32", "bfloat16") if has_tf32(settings.device_type) else ("float32", "bfloat16")


def _with_a_bar(checks: list[Check]) -> list[Row]:
    columns = (BarColumn(20), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=stderr_console(), transient=True) as bar:
        task = bar.add_task("", total=len(checks), completed=-1)

        def announce(name: str) -> None:
            bar.update(task, advance=1, description=name)

        return carry_out(checks, announce)


def _print(rows: list[Row], settings: TrainerSettings, seconds: float) -> None:
    counts = {outcome: sum(row.outcome == outcome for row in rows) for outcome in ("ok", "wrong", "not run")}
    found = ", ".join(f"{count} {outcome}" for outcome, count in counts.items())
    StdoutConsole(width=120).print(result_table(rows, f"nerf selftest: {settings.describe()}"))
    say(*remarks(rows), f"{found}; {seconds:.0f} seconds")

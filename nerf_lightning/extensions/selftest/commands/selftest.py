"""Verify kernels and numerics on this machine, with a table for bug reports."""

import os
import re
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from rich.progress import track
from torch.utils import collect_env

from nerf_lightning import __version__
from nerf_lightning.compute.environment import environment
from nerf_lightning.compute.precision import has_tf32
from nerf_lightning.config.instantiate import build
from nerf_lightning.extensions.selftest import kernels, training
from nerf_lightning.extensions.selftest.check import Row, carried_out, remarks, result_table
from nerf_lightning.files.json_files import print_json, write_json
from nerf_lightning.messages.console import StdoutConsole, say, say_written, spoken, stderr_console
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.matmul_precision import MatmulPrecision
from nerf_lightning.runs.command_folder import output_folder
from nerf_lightning.training.launch.trainer import TrainerSettings

DEVICES = ("cpu", "cuda")
FLAGS = re.compile(r"\b(sse4_2|avx|avx2|fma|avx512\w*|avx_\w+|amx\w*|asimd\w*|bf16|i8mm|sve\w*)\b")


def run(config: DictConfig) -> None:
    """Check what the configured trainer would use, print a table and write selftest.json.

    Raises:
        InputError: the device is neither a CPU nor a CUDA GPU.
        SystemExit: something is wrong (exit code 1).
    """
    began = time.perf_counter()
    settings: TrainerSettings = build(config.trainer)
    if settings.device_type not in DEVICES:
        raise InputError(
            f"nerf selftest supports CPUs and NVIDIA GPUs, but trainer.accelerator chose {settings.device_type}. Use "
            "trainer=cpu; for TPUs there is make test-xla."
        )
    settings.prepare_machine()
    folder = output_folder(config.paths.output_dir, Path(config.paths.root_dir) / "selftest")
    rows = _rows(settings)
    known = {"nerf_lightning": __version__} | environment() | machine(settings.device)
    result = {"right": all(row.outcome != "wrong" for row in rows), "device": settings.describe(), "machine": known}
    result |= {"checks": [asdict(row) for row in rows]}
    write_json(folder / "selftest.json", result)
    if config.json:
        print_json(result | {"written": [folder / "selftest.json"]})
    else:
        _print(rows, settings.describe(), known, time.perf_counter() - began)
        say_written(folder / "selftest.json")
    if not result["right"]:
        raise SystemExit(1)


def _print(rows: list[Row], device: str, machine_info: dict[str, Any], seconds: float) -> None:
    StdoutConsole(width=120).print(result_table(rows, f"nerf selftest: {device}"))
    counts = ", ".join(f"{sum(row.outcome == each for row in rows)} {each}" for each in ("ok", "wrong", "not run"))
    say(*remarks(rows), f"{counts}; {spoken(seconds)}")
    say(*(f"{name.replace('_', ' ')}: {_in_words(value)}" for name, value in machine_info.items()))


def _rows(settings: TrainerSettings) -> list[Row]:
    """Do all checks."""
    precisions: tuple[MatmulPrecision, ...] = ("float32", "bfloat16")
    if has_tf32(settings.device_type):
        precisions = ("float32", "tf32", "bfloat16")
    checks = [*kernels.checks(settings.device, precisions), *training.checks(settings.device, precisions)]
    return [carried_out(check) for check in track(checks, transient=True, console=stderr_console())]


def _in_words(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {part}" for key, part in value.items())
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def machine(device: torch.device) -> dict[str, Any]:
    """Return what a bug report should say about this machine, besides library versions."""
    known: dict[str, Any] = {
        "cpu_capability": torch.backends.cpu.get_cpu_capability(),
        "cpu_flags": " ".join(sorted(set(FLAGS.findall(collect_env.get_cpu_info(collect_env.run))))) or "unknown",
        "threads": {"torch": torch.get_num_threads(), "of the machine": os.cpu_count()},
    }
    if device.type == "cuda":
        free, total = (round(size / 1e9, 1) for size in torch.cuda.mem_get_info(device))
        known |= {
            "gpu": str(torch.cuda.get_device_properties(device)),
            "gpu_memory_gigabytes": {"total": total, "free": free},
            "driver": collect_env.get_nvidia_driver_version(collect_env.run),
            "cudnn": torch.backends.cudnn.version(),
            "allow_tf32": {
                "matrices": torch.get_float32_matmul_precision(),
                "convolutions": torch.backends.cudnn.allow_tf32,
            },
        }
    return known

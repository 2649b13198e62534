"""Measure training and rendering speed, compared with plain PyTorch and with the machine's matrix rate.

Results are medians of ratios: machines are noisy and their speed drifts, so every round measures each kind once, and
two kinds are compared round by round. Kinds: the configured step (tiled or replayed, in the configured precision), the
same step in plain float32 without tiles, a replayed step with its kernels launched one by one, the machine's matrix
product, making a batch, the configured step with batches from the loader, and rendering.
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from omegaconf import DictConfig
from rich.progress import track
from rich.table import Table

from nerf_lightning.commands.train_job.build import composed
from nerf_lightning.compute.cores import num_cores
from nerf_lightning.compute.machine import peak_memory, seconds_of, torch_threads
from nerf_lightning.config.auto_settings import fit_model
from nerf_lightning.config.instantiate import build
from nerf_lightning.extensions.bench.kernels import compared_kernels
from nerf_lightning.extensions.bench.prepared import Bench, prepare
from nerf_lightning.extensions.bench.stages import (
    MATRIX_FLOPS,
    LoadedSteps,
    flops_per_ray,
    multiplication,
    stage_seconds,
)
from nerf_lightning.files.json_files import print_json, write_json
from nerf_lightning.files.made_folders import make_folder
from nerf_lightning.messages.console import StdoutConsole, say_written, stderr_console
from nerf_lightning.nerf.types.scene import Scene
from nerf_lightning.runs.plan_run import read_scene

Work = Callable[[], Any]
Rows = dict[str, Float[np.ndarray, "rounds"]]


def run(config: DictConfig) -> float:
    """Measure, print a table and write bench.json; return training rays per second."""
    config, scene = _config_and_scene(config)
    bench = prepare(config, scene)
    for _ in track(range(config.warmup_steps), "training first", console=stderr_console(), transient=True):
        bench.take_step()
    bench.train(config.steps)
    peak = peak_memory()  # before the whole batches of the plain kinds
    rows, flops = _rows_of_steps(bench, config)
    if config.kernels:
        rows |= _rows_of_kernels(bench.settings.device, config.rounds)
    result: dict[str, Any] = {
        name: {"median": float(np.median(values)), "min": float(values.min()), "max": float(values.max())}
        for name, values in rows.items()
    }
    result |= {
        "machine": bench.settings.describe(),
        "tile_points": None if bench.train_step.gradients.replays else bench.settings.tile_points,
        "batch_rays": bench.batch.num_rays,
        "training_flops_per_ray": flops,
        "peak_memory_gigabytes": peak,
        "rounds": config.rounds,
    }
    folder = make_folder(Path(config.paths.output_dir or Path(config.paths.root_dir) / "bench"))
    write_json(folder / "bench.json", result)
    if config.json:
        print_json(result | {"written": [folder / "bench.json"]})
    else:
        _print_table(result)
        say_written(folder / "bench.json")
    return float(result["training rays/s"]["median"])


def _config_and_scene(config: DictConfig) -> tuple[DictConfig, Scene]:
    """Return the config with the choices for its scene, and the scene."""
    on_gpu = build(config.trainer).device_type == "cuda"
    asked, scene = read_scene(composed("bench", config), on_gpu)
    return fit_model(asked, scene, on_gpu).config, scene


def _interleaved(kinds: Mapping[str, Work], rounds: int) -> Rows:
    """Return the seconds of each kind."""
    seconds: dict[str, list[float]] = {name: [] for name in kinds}
    for number in range(rounds + 1):
        for name, work in kinds.items():
            taken = seconds_of(work)
            if number:  # the first round warms up
                seconds[name].append(taken)
    return {name: np.array(values) for name, values in seconds.items()}


def _rows_of_steps(bench: Bench, config: DictConfig) -> tuple[Rows, float]:
    """Return the rows about training and rendering, and the operations of training per ray."""
    steps, render_rays = config.steps, config.render_rays
    loaded_steps = LoadedSteps(bench.batches, bench.train_on, steps)
    scales = config.scaling and bench.settings.device_type == "cpu"
    threads = [2**k for k in range(num_cores().bit_length())] if scales else []
    kinds: dict[str, Work] = {
        "matrix": multiplication(bench.settings),
        "train": partial(bench.train, steps),
        "train_plain": partial(bench.train_plainly, steps),
        "load": lambda: bench.batches.batch_at(0, bench.batches.crop_rays(0)),
        "loaded": loaded_steps,
        "render": partial(bench.render, render_rays),
        "render_plain": partial(bench.render, render_rays, plain=True),
        **({"one by one": partial(bench.train_one_by_one, steps)} if bench.train_step.gradients.replays else {}),
        **{f"train on {count}": partial(_on_threads, count, partial(bench.train, steps)) for count in threads},
    }
    seconds = _interleaved(kinds, config.rounds)
    train, wait = seconds["train"], np.array(loaded_steps.waits[1:])
    flops, train_rays = flops_per_ray(bench.train_step, bench.batch), bench.batch.num_rays * steps
    rate, matrix_rate = train_rays * flops / train, MATRIX_FLOPS / seconds["matrix"]
    rows = {
        "training rays/s": train_rays / train,
        "training, times plain float32": seconds["train_plain"] / train,
        "training GFLOP/s": rate / 1e9,
        "matrix GFLOP/s": matrix_rate / 1e9,
        "training, share of the matrix rate": rate / matrix_rate,
        "making a batch, milliseconds": 1e3 * seconds["load"],
        "waiting for a batch, milliseconds": 1e3 * wait,
        "waiting, share of a step": wait * steps / train,
        "rendering rays/s": render_rays / seconds["render"],
        "rendering, times plain float32": seconds["render_plain"] / seconds["render"],
    }
    if bench.train_step.gradients.replays:
        rows["training, times kernels launched one by one"] = seconds["one by one"] / train
    stages = [stage_seconds(bench.train_step, bench.batch, bench.optimizer) for _ in range(config.rounds)]
    for name in stages[0]:
        rows[f"{name}, share of a step"] = np.array([each[name] for each in stages]) * steps / train
    for count in threads:
        label = "training on 1 thread, milliseconds" if count == 1 else f"training on {count} threads, times one"
        one, more = seconds["train on 1"], seconds[f"train on {count}"]
        rows[label] = 1e3 * one / steps if count == 1 else one / more
    if len(threads) > 1:  # Amdahl's law: t_n / t_1 = s + (1 - s) / n
        count, share = threads[-1], seconds[f"train on {threads[-1]}"] / seconds["train on 1"]
        rows["share of a step that takes one thread alone"] = ((count * share - 1.0) / (count - 1.0)).clip(0.0, 1.0)
    return rows, flops


def _on_threads(count: int, work: Work) -> None:
    with torch_threads(count):
        work()


def _rows_of_kernels(device: torch.device, rounds: int) -> Rows:
    """Return the time of our kernels, and torch's time relative to it."""
    rows = {}
    for name, works in compared_kernels(device).items():
        seconds = _interleaved(works, rounds)
        ours = seconds.pop("ours")
        rows[f"{name}, milliseconds"] = 1e3 * ours
        rows |= {f"{name}, times torch {other}": theirs / ours for other, theirs in seconds.items()}
    return rows


def _print_table(result: dict[str, Any]) -> None:
    """Print a row for each quantity."""
    tile = result["tile_points"]
    cut = "whole batches" if tile is None else f"tiles of {tile} points"
    table = Table(title=f"nerf bench: {result['machine']}, {cut}")
    for column in ("", "median", "min", "max"):
        table.add_column(column, justify="left" if not column else "right")
    for name, value in result.items():
        if isinstance(value, dict):
            table.add_row(name, *(f"{value[key]:,.3g}" if value[key] < 100 else f"{value[key]:,.0f}" for key in value))
    table.add_row("peak memory, GB", f"{result['peak_memory_gigabytes']:.2f}", "", "")
    StdoutConsole(width=100).print(table)

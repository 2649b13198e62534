"""`nerf bench`: interleaved measurements, medians of ratios.

Machines are noisy and their speed drifts, so every round measures each kind once, and two kinds are compared round by
round. Kinds: the configured step (tiled, in the configured precision), the same step in plain float32 without tiles,
the machine's matrix product in either precision, loading a batch, and rendering.
"""

import json
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table
from torch.utils.flop_counter import FlopCounterMode

from nerf_lightning.commands.build import build, build_system
from nerf_lightning.commands.trainer import TrainerSettings
from nerf_lightning.data.ray_batches import Progress, RayBatches
from nerf_lightning.export.atomic import whole_file
from nerf_lightning.models.levels import RadianceModel
from nerf_lightning.models.pictures import tile_rays_for, tiles
from nerf_lightning.rendering.blending import background_colors
from nerf_lightning.system import RadianceFieldSystem
from nerf_lightning.types import Batch, RayBundle

MATRIX_ROWS, MATRIX_WIDTH, MATRIX_REPEATS = 4096, 256, 20


@dataclass
class Bench:
    """What is measured, ready to run."""

    settings: TrainerSettings
    system: RadianceFieldSystem
    batches: RayBatches
    batch: Batch
    optimizer: torch.optim.Optimizer


def benchmark(config: DictConfig) -> float:
    """Measure as the config says."""
    bench = _prepare(config)
    kinds: dict[str, Callable[[], None]] = {
        "matrix": _multiplication(bench.settings),
        "train": lambda: _train(bench, config.steps, plain=False),
        "train_plain": lambda: _train(bench, config.steps, plain=True),
        "load": lambda: _load(bench),
        "render": lambda: _render(bench, config.render_rays, plain=False),
        "render_plain": lambda: _render(bench, config.render_rays, plain=True),
    }
    kinds["train"]()
    peak = _peak_memory()  # before the whole batches of the plain kinds
    seconds = _interleaved(kinds, config.rounds)
    num_rays = bench.batches.batch_rays
    flops = _flops_per_ray(bench)
    per_round = [_round(seconds, i, num_rays, config.steps, config.render_rays, flops) for i in range(config.rounds)]
    result: dict[str, Any] = {name: _spread([row[name] for row in per_round]) for name in per_round[0]}
    result |= {
        "machine": bench.settings.describe(),
        "tile_points": bench.settings.tile_points,
        "batch_rays": num_rays,
        "training_flops_per_ray": flops,
        "peak_memory_gigabytes": peak,
        "rounds": config.rounds,
    }
    _print_table(result)
    folder = Path(config.paths.output_dir or Path(config.paths.root_dir) / "bench")
    with whole_file(folder / "bench.json") as part:
        part.write_text(json.dumps(result, indent=2) + "\n")
    print(f"written to {folder / 'bench.json'}")
    return float(result["training rays/s"]["median"])


def _prepare(config: DictConfig) -> Bench:
    settings: TrainerSettings = build(config.trainer)
    settings.prepare_machine()
    scene = build(config.scene).read()
    progress = Progress()
    system = build_system(config, settings, scene, progress, 1, {}).to(settings.device)
    system.initialize()
    batches = build(config.data)(scene=scene, progress=progress, seed=config.seed, num_steps=1).batches
    batch = batches.at(0, batches.crop_rays(0)).to(settings.device)
    return Bench(settings, system, batches, batch, system.configure_optimizers())


def _interleaved(kinds: dict[str, Callable[[], None]], rounds: int) -> dict[str, list[float]]:
    seconds: dict[str, list[float]] = {name: [] for name in kinds}
    for number in range(rounds + 1):
        for name, work in kinds.items():
            start = time.perf_counter()
            work()
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            if number:  # the first round warms up
                seconds[name].append(time.perf_counter() - start)
    return seconds


def _round(
    seconds: dict[str, list[float]], i: int, batch_rays: int, steps: int, render_rays: int, flops: float
) -> dict[str, float]:
    train_rays = batch_rays * steps
    matrix_rate = 2 * MATRIX_ROWS * MATRIX_WIDTH**2 * MATRIX_REPEATS / seconds["matrix"][i]
    rate = train_rays * flops / seconds["train"][i]
    return {
        "training rays/s": train_rays / seconds["train"][i],
        "training, times plain float32": seconds["train_plain"][i] / seconds["train"][i],
        "training GFLOP/s": rate / 1e9,
        "matrix GFLOP/s": matrix_rate / 1e9,
        "training, share of the matrix rate": rate / matrix_rate,
        "loading, share of a step": seconds["load"][i] * steps / seconds["train"][i],
        "rendering rays/s": render_rays / seconds["render"][i],
        "rendering, times plain float32": seconds["render_plain"][i] / seconds["render"][i],
    }


def _train(bench: Bench, steps: int, plain: bool) -> None:
    tile, half = bench.settings.tile_points, bench.settings.precision.startswith("bf16")
    bench.system.tile_points = None if plain else tile
    for _ in range(steps):
        bench.optimizer.zero_grad()
        with torch.autocast(bench.settings.device_type, torch.bfloat16, enabled=half and not plain):
            bench.system.accumulate_gradients(bench.batch, lambda loss: loss.backward())
        bench.optimizer.step()
    bench.system.tile_points = tile


def _load(bench: Bench) -> None:
    bench.batches.at(0, bench.batches.crop_rays(0))


def _render(bench: Bench, num_rays: int, plain: bool) -> None:
    rays = bench.batch.rays[torch.arange(num_rays, device=bench.settings.device) % bench.batches.batch_rays]
    size = num_rays if plain else tile_rays_for(bench.system.model, bench.settings.inference_tile_points)
    half = bench.settings.precision.startswith("bf16") and not plain
    with torch.no_grad(), torch.autocast(bench.settings.device_type, torch.bfloat16, enabled=half):
        for part in tiles(num_rays, size):
            _render_tile(bench.system.model, rays[part], bench)


def _render_tile(model: RadianceModel, rays: RayBundle, bench: Bench) -> None:
    behind = background_colors(bench.system.background, rays.near.numel(), rays.near.device, random=None)
    model(rays, behind, random=None)


def _multiplication(settings: TrainerSettings) -> Callable[[], None]:
    dtype = torch.bfloat16 if settings.precision.startswith("bf16") else torch.float32
    left = torch.randn(MATRIX_ROWS, MATRIX_WIDTH, device=settings.device).to(dtype)
    right = torch.randn(MATRIX_WIDTH, MATRIX_WIDTH, device=settings.device).to(dtype)
    out = torch.empty_like(left)

    def multiply() -> None:
        for _ in range(MATRIX_REPEATS):
            torch.mm(left, right, out=out)

    return multiply


def _flops_per_ray(bench: Bench) -> float:
    few = 8
    rays = Batch(bench.batch.rays[:few], bench.batch.rgba[:few])
    with FlopCounterMode(display=False) as counter:
        bench.system.accumulate_gradients(rays, lambda loss: loss.backward())
    return counter.get_total_flops() / few


def _spread(values: list[float]) -> dict[str, float]:
    return {"median": statistics.median(values), "min": min(values), "max": max(values)}


def _peak_memory() -> float:
    if torch.cuda.is_available():
        return torch.cuda.max_memory_allocated() / 1e9
    if sys.platform == "win32":
        return float(psutil.Process().memory_info().peak_wset) / 1e9
    import resource

    # Kilobytes on Linux, bytes on macOS.
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


def _print_table(result: dict[str, Any]) -> None:
    table = Table(title=f"nerf bench: {result['machine']}, tiles of {result['tile_points']} points")
    for column in ("", "median", "min", "max"):
        table.add_column(column, justify="left" if not column else "right")
    for name, value in result.items():
        if isinstance(value, dict):
            table.add_row(name, *(f"{value[key]:,.3g}" if value[key] < 100 else f"{value[key]:,.0f}" for key in value))
    table.add_row("peak memory, GB", f"{result['peak_memory_gigabytes']:.2f}", "", "")
    Console(width=100).print(table)

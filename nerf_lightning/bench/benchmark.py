"""`nerf bench`: interleaved measurements, medians of ratios.

Machines are noisy and their speed drifts, so every round measures each kind once, and two kinds are compared round by
round. Kinds: the configured step (tiled, in the configured precision), the same step in plain float32 without tiles,
the machine's matrix product, making a batch, the configured step with batches from the loader, and rendering. "Plain"
is the same mathematics as one would first write it: float32, whole batches, torch around the same hash grid kernel, no
screening of what lies behind opaque samples.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from rich.progress import track

from nerf_lightning.bench.callbacks import watching_seconds
from nerf_lightning.bench.kernels import kernel_ratios
from nerf_lightning.bench.stages import (
    MATRIX_FLOPS,
    LoadedSteps,
    flops_per_ray,
    multiplication,
    seconds_to_psnr,
    stage_seconds,
)
from nerf_lightning.bench.table import min_median_max, print_table
from nerf_lightning.compute.machine import peak_memory, seconds_of
from nerf_lightning.config.instantiate import build
from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.files.json_files import write_json
from nerf_lightning.files.made_folders import make_folder
from nerf_lightning.messages.console import say, stderr_console
from nerf_lightning.nerf.kernels.backends import without
from nerf_lightning.nerf.models.packed_level import PackedLevel
from nerf_lightning.nerf.models.render_image import render_rays
from nerf_lightning.nerf.rendering.blending import background_colors
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.nerf.types.rays import Batch
from nerf_lightning.nerf.types.scene import Scene
from nerf_lightning.training.build_step import build_step
from nerf_lightning.training.callbacks.watcher import Watcher
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.step import TrainStep
from nerf_lightning.training.tile_size import measured_tile

MOST_STEPS = 2000


@dataclass
class Bench:
    """What is measured, ready to run."""

    settings: TrainerSettings
    step: TrainStep
    data: RayDataModule
    optimizer: torch.optim.Optimizer
    plain_optimizer: torch.optim.Optimizer

    @property
    def batches(self) -> RayBatches:
        """The training rays."""
        return self.data.batches

    @cached_property
    def batch(self) -> Batch:
        """The batch that every kind gets, as large as batches are once the model has been trained."""
        return self.batches.at(0, self.batches.crop_rays(0)).to(self.settings.device)

    def train_on(self, batch: Batch, plain: bool = False) -> None:
        """Compute gradients and update, and nothing else."""
        optimizer = self.plain_optimizer if plain else self.optimizer
        optimizer.zero_grad()
        self.step.gradients(batch)
        optimizer.step()

    def take_step(self) -> None:
        """Take one step of training, loading and all."""
        progress = self.batches.progress
        batch = self.batches.at(progress.attempt, progress.rays_seen).to(self.settings.device)
        self.step(batch, self.optimizer)


def benchmark(config: DictConfig) -> float:
    """Measure as the config says."""
    bench = prepare(config, build(config.scene).read())
    reached = _train_first(bench, config)
    loaded_steps = LoadedSteps(bench.batches, bench.train_on, config.steps)
    kinds: dict[str, Callable[[], Any]] = {
        "matrix": multiplication(bench.settings),
        "train": lambda: _train(bench, config.steps, plain=False),
        "train_plain": lambda: _train(bench, config.steps, plain=True),
        "load": lambda: bench.batches.at(0, bench.batches.crop_rays(0)),
        "loaded": loaded_steps,
        "render": lambda: _render(bench, config.render_rays, plain=False),
        "render_plain": lambda: _render(bench, config.render_rays, plain=True),
    }
    kinds["train"]()
    peak = peak_memory()  # before the whole batches of the plain kinds
    seconds = _interleaved(kinds, config.rounds)
    num_rays = bench.batch.num_rays
    flops = flops_per_ray(bench.step, bench.batch)
    seconds["wait"] = loaded_steps.waits[1:]
    per_round = [_round(seconds, i, num_rays, config.steps, config.render_rays, flops) for i in range(config.rounds)]
    result: dict[str, Any] = {name: min_median_max([row[name] for row in per_round]) for name in per_round[0]}
    result |= {name: min_median_max(values) for name, values in _stages(bench, seconds["train"], config.steps).items()}
    watching = _watching(bench, config)
    steps = [one / config.steps for one in seconds["train"]]
    result |= {name: min_median_max([value / step for step in steps]) for name, value in watching.items()}
    if config.kernels:
        ratios = kernel_ratios(bench.settings.device, config.rounds)
        result |= {name: min_median_max(values) for name, values in ratios.items()}
    result |= {
        "seconds_and_steps_to_target_psnr": reached,
        "machine": bench.settings.describe(),
        "tile_points": bench.settings.tile_points,
        "batch_rays": num_rays,
        "training_flops_per_ray": flops,
        "peak_memory_gigabytes": peak,
        "rounds": config.rounds,
    }
    print_table(result)
    folder = make_folder(Path(config.paths.output_dir or Path(config.paths.root_dir) / "bench"))
    write_json(folder / "bench.json", result)
    say(f"written to {folder / 'bench.json'}")
    return float(result["training rays/s"]["median"])


def _train_first(bench: Bench, config: DictConfig) -> tuple[float, int] | None:
    """Train until a PSNR is reached, and return seconds and steps; or for a number of steps."""
    if config.target_psnr is not None:
        most = config.warmup_steps or MOST_STEPS
        return seconds_to_psnr(bench.take_step, bench.step, bench.batches, config.target_psnr, most)
    for _ in track(range(config.warmup_steps), "training first", console=stderr_console(), transient=True):
        bench.take_step()
    return None


def prepare(config: DictConfig, scene: Scene) -> Bench:
    """Build what is to be measured."""
    settings: TrainerSettings = build(config.trainer)
    settings.prepare_machine()
    progress = Progress()
    step = build_step(config, settings, scene, progress).to(settings.device)
    step.num_steps = max(1, config.warmup_steps)
    settings.prepare(step.model)
    data = build(config.data)(scene=scene, progress=progress, seed=config.seed, patch=step.loss.patch)
    data.settle(settings.device)
    if settings.measures_tile:
        settings.tile_points = step.tile_points = measured_tile(settings, step, data.batches)
    optimizer, plain = step.new_optimizer(), torch.optim.Adam(step.model.parameters(), lr=1e-6)
    return Bench(settings, step, data, optimizer, plain)


def _interleaved(kinds: dict[str, Callable[[], Any]], rounds: int) -> dict[str, list[float]]:
    seconds: dict[str, list[float]] = {name: [] for name in kinds}
    for number in range(rounds + 1):
        for name, work in kinds.items():
            taken = seconds_of(work)
            if number:  # the first round warms up
                seconds[name].append(taken)
    return seconds


def _round(
    seconds: dict[str, list[float]], i: int, batch_rays: int, steps: int, render_rays: int, flops: float
) -> dict[str, float]:
    train_rays = batch_rays * steps
    matrix_rate = MATRIX_FLOPS / seconds["matrix"][i]
    rate = train_rays * flops / seconds["train"][i]
    return {
        "training rays/s": train_rays / seconds["train"][i],
        "training, times plain float32": seconds["train_plain"][i] / seconds["train"][i],
        "training GFLOP/s": rate / 1e9,
        "matrix GFLOP/s": matrix_rate / 1e9,
        "training, share of the matrix rate": rate / matrix_rate,
        "making a batch, milliseconds": 1e3 * seconds["load"][i],
        "waiting for a batch, milliseconds": 1e3 * seconds["wait"][i],
        "waiting, share of a step": seconds["wait"][i] * steps / seconds["train"][i],
        "rendering rays/s": render_rays / seconds["render"][i],
        "rendering, times plain float32": seconds["render_plain"][i] / seconds["render"][i],
    }


def _train(bench: Bench, steps: int, plain: bool) -> None:
    with _plainly(bench) if plain else nullcontext():
        for _ in range(steps):
            bench.train_on(bench.batch, plain)
    bench.step.tile_points = bench.settings.tile_points


@contextmanager
def _plainly(bench: Bench) -> Iterator[None]:
    """Compute as one would first write it; our kernel of the hash grid stays."""
    samplers = [level.sampler for level in bench.step.model.modules() if isinstance(level, PackedLevel)]
    former = [sampler.opaque_below for sampler in samplers]
    bench.step.tile_points = None
    bench.step.model.multiply_in("float32")
    for sampler in samplers:
        sampler.opaque_below = 0.0
    _release_gradients(bench)
    with without("march.cpu", "packed.cpu", "mlp.cpu", "adam.cpu", "render.cpu", "render.gradients"):
        yield
    bench.settings.prepare(bench.step.model)
    for sampler, value in zip(samplers, former, strict=True):
        sampler.opaque_below = value
    _release_gradients(bench)


def _release_gradients(bench: Bench) -> None:
    for parameter in bench.step.model.parameters():
        parameter.grad = None
        parameter.grad_in_place = False  # type: ignore[attr-defined]


def _stages(bench: Bench, seconds: list[float], steps: int) -> dict[str, list[float]]:
    """Return the share of a step's time that each stage takes, where the model has stages."""
    result: dict[str, list[float]] = {}
    for one in seconds:
        for name, value in stage_seconds(bench.step, bench.batch, bench.optimizer).items():
            result.setdefault(f"{name}, share of a step", []).append(value * steps / one)
    return result


def _watching(bench: Bench, config: DictConfig) -> dict[str, float]:
    """Return the seconds per step that go into TensorBoard, in all and by what is shown."""
    watchers = [callback for callback in build(config.callbacks).values() if isinstance(callback, Watcher)]
    seconds = watching_seconds(watchers, bench.step, bench.optimizer, bench.data, bench.batch)
    return {"watching, share of a step": sum(seconds.values())} | {
        f"watching: {name}, share of a step": value for name, value in seconds.items()
    }


def _render(bench: Bench, num_rays: int, plain: bool) -> None:
    places = torch.arange(num_rays, device=bench.settings.device) % bench.batch.num_rays
    model, background = bench.step.model, bench.step.background
    with torch.no_grad():
        rays = bench.step.rays(bench.batch.pixels[places])
        if not plain:  # as pictures are
            render_rays(model, rays, background, bench.settings.inference_tile_points)
            return
        with _plainly(bench):
            model(rays, background_colors(background, num_rays, rays.near.device, random=None), random=None)

"""What is known of GPUs without one, as tables in Markdown.

    python tests/gpu_report.py kernels [sm_89 ...]
    python tests/gpu_report.py steps|memory [fast ...]

`kernels`: registers, bytes that no register had room for, and bytes of shared memory of each of triton's kernels, as it
compiles them ahead of time for a step and a tile of a few models. `steps`: operations, bytes and
arithmetic of a step at the batch of each model, counted on a stand-in, and the least time that they take on a few GPUs.
`memory`: what training a model takes in all, and the largest batches for GPUs of 8, 12 and 24 GB.
"""

import re
import sys
from collections import defaultdict
from typing import Any

import torch
from support.configs import composed, options
from support.gpu_targets import DEVICES, compiled_for, resources
from support.gpu_training import small, step_by_step
from support.launches import KERNEL, Launches
from support.peak_bytes import PeakBytes
from support.stand_in_device import StandInDevice

from nerf_lightning.nerf.optimizers.table_adam import TableAdam

OTHERS = ("auto", "view_transformer", "view_transformer_tiny")
COMPILED = ("fast", "fast_large", "fast_proposal")
SHARES = (1 / 64, 1 / 32)
"""Of a batch, which are counted: what a step asks for is a constant and a part that grows with the batch."""
CARDS = {"T4": (320, 8), "RTX 3060": (360, 25), "RTX 4090": (1008, 165), "A100": (1555, 312), "H100": (3350, 989)}
"""GB/s of memory and TFLOP/s, bfloat16 (T4: float32), of NVIDIA's data sheets."""
LAUNCH = (6, 9)
"""Microseconds that torch takes to begin an operation, about."""
GIGABYTES, FREE, CONTEXT = (8, 12, 24), 0.9, 0.6
"""Of cards; the share that a desktop and the allocator's gaps leave; and what CUDA and its libraries take."""


def kernels(names: list[str]) -> None:
    """Print a row for each kernel, a column for each GPU."""
    run = KERNEL.run
    cells: dict[str, dict[str, tuple[int, ...]]] = defaultdict(dict)
    for name in names:
        made: dict[str, list[Any]] = defaultdict(list)

        def compile_only(kernel: Any, *args: Any, made: Any = made, **given: Any) -> None:
            module = kernel.fn.__module__.split(".")[-2]
            made[f"{module}: {kernel.__name__.lstrip('_')}"].append(run(kernel, *args, **given | {"warmup": True}))

        with compiled_for(name, {}), StandInDevice("cuda") as there, Launches(compile_only):
            for model in COMPILED:
                step_and_tile(model, there.device, "32-true" if name == "sm_75" else "bf16-mixed")
        for kernel, compiled in made.items():
            cells[kernel][name] = tuple(map(max, zip(*map(resources, compiled), strict=True)))
    print("| kernel |", " | ".join(names), "|\n|---|" + "---|" * len(names))
    for kernel in sorted(cells):
        told = (" / ".join(map(str, cells[kernel][name])) if name in cells[kernel] else "torch" for name in names)
        print(f"| {kernel} |", " | ".join(told), "|", flush=True)


def step_and_tile(model: str, device: torch.device, precision: str) -> None:
    """Launch all kernels of a model of its own widths and grids, but for a small occupancy grid."""
    quick = [each for each in small(model) if re.search("resolution|data.batch_rays", each)]
    run = step_by_step(model, device, precision, None, *(each for each in quick if "encoder" not in each))
    run.step()
    rays = run.training.objective.rays(run.loader.batch_at(0, 0).pixels)
    with torch.no_grad():
        run.training.objective.model.eval()(rays, torch.ones_like(rays.origins), None)


def steps(models: list[str]) -> None:
    """Print a row for each model."""
    print("| model | rays, samples | operations | GB | TFLOP |", " | ".join(CARDS), "|\n|" + "---|" * (5 + len(CARDS)))
    for model in models:
        data, few, slope = measured(model)
        whole = {key: few[key] + (1 - SHARES[0]) * slope[key] for key in few}
        asked = few["operations"] + few["kernels"]
        times = (bound(asked, whole, *card) for card in CARDS.values())
        row = batch(data, 1), str(asked), f"{whole['bytes'] / 1e9:.2f}", f"{whole.get('flops', 0) / 1e12:.3f}", *times
        print(f"| {model} |", " | ".join(row), "|", flush=True)


def memory(models: list[str]) -> None:
    """Print a row for each model."""
    print("| model | its batch | GB |", " | ".join(f"{size} GB" for size in GIGABYTES), "|\n|" + "---|" * 6)
    for model in models:
        data, few, slope = measured(model)
        held, of_batch = few["peak"] / 1e9 + CONTEXT, slope["peak"] / 1e9
        whole = held + (1 - SHARES[0]) * of_batch
        largest = (batch(data, SHARES[0] + (FREE * size - held) / of_batch) for size in GIGABYTES)
        print(f"| {model} |", " | ".join((batch(data, 1), f"{whole:.1f}", *largest)), "|", flush=True)


def batch(data: Any, share: float) -> str:
    """Return what decides how much a step takes, for a share of the model's own batch."""
    samples = data.sample_budget is not None
    count = (data.sample_budget if samples else data.batch_rays) * share
    return f"{count if share == 1 else float(f'{count:.2g}'):,.0f} {'samples' if samples else 'rays'}"


def measured(model: str) -> tuple[Any, dict[str, int], dict[str, float]]:
    """Return a model's settings of data, what a small share of its batch asks for, and what a whole one adds."""
    data = composed("train", f"model={model}").data
    few, more = (counted(model, data, share) for share in SHARES)
    return data, few, {key: (more[key] - few[key]) / (SHARES[1] - SHARES[0]) for key in few}


def counted(model: str, data: Any, share: float) -> dict[str, int]:
    """Count the third step of a share of a batch, on a small occupancy grid; kernels do nothing; `peak` is of all."""
    budget = None if data.sample_budget is None else int(data.sample_budget * share)
    changes = [f"data.batch_rays={int(data.batch_rays * share)}", f"data.sample_budget={budget or 'null'}"]
    changes += [each for each in small(model) if "sampler.resolution" in each]
    nothing = Launches(lambda *given, **options: None)
    with PeakBytes("cpu") as memory, StandInDevice("cuda") as there, nothing as launches:
        run = step_by_step(model, there.device, "bf16-mixed", None, *changes)
        for _ in range(3):
            launches.counts.clear()
            run.training.progress.batch_rays = int(data.batch_rays * share)  # a first step's samples are not known yet
            run.step()
        learnt = [each for group in run.optimizer.param_groups for each in group["params"]]
        if isinstance(run.optimizer, TableAdam):  # its kernel is given addresses: of weights, gradients and moments
            launches.counts["bytes"] += 4 * sum(each.nbytes for each in learnt)
        return dict(launches.counts, peak=memory.most)


def bound(operations: int, whole: dict[str, float], bandwidth: float, teraflops: float) -> str:
    """Return milliseconds: what memory and arithmetic take, or beginning the operations, whichever is more."""
    on_device = max(whole["bytes"] / bandwidth / 1e9, whole.get("flops", 0) / teraflops / 1e12)
    low, high = (1e3 * max(on_device, operations * each * 1e-6) for each in LAUNCH)
    return f"{low:.1f}" if low == high else f"{low:.1f} to {high:.1f}"


if __name__ == "__main__":
    what, *named = sys.argv[1:] or [""]
    if what == "kernels":
        kernels(named or list(DEVICES))
    elif what in ("steps", "memory"):
        {"steps": steps, "memory": memory}[what](named or [each for each in options("model") if each not in OTHERS])
    else:
        sys.exit(__doc__)

"""What is known of GPUs without one, as tables in Markdown.

    python tests/gpu_report.py kernels [sm_89 ...]
    python tests/gpu_report.py steps [fast ...]

`kernels`: registers, bytes that no register had room for, and bytes of shared memory of each of triton's kernels, as it
compiles them ahead of time for a step and a tile of model=fast and fast_proposal. `steps`: operations, bytes and
arithmetic of a step at the batch of each model, counted on a stand-in, and the least time that they take on a few GPUs.
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
from support.stand_in_device import StandInDevice

COMPILED = ("fast", "fast_proposal")
SHARES = (1 / 64, 1 / 32)
"""Of a batch, which are counted: what a step asks for is a constant and a part that grows with the batch."""
CARDS = {"T4": (320, 8), "RTX 3060": (360, 25), "RTX 4090": (1008, 165), "A100": (1555, 312), "H100": (3350, 989)}
"""GB/s of memory and TFLOP/s, bfloat16 (T4: float32), of NVIDIA's data sheets."""
LAUNCH = (6, 9)
"""Microseconds that torch takes to begin an operation, about."""


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
    rays = run.training.rays(run.loader.at(0, 0).pixels)
    with torch.no_grad():
        run.training.model.eval()(rays, torch.ones_like(rays.origins), None)


def steps(models: list[str]) -> None:
    """Print a row for each model."""
    print("| model | rays, samples | operations | GB | TFLOP |", " | ".join(CARDS), "|\n|" + "---|" * (5 + len(CARDS)))
    for model in models:
        data = composed("train", f"model={model}").data
        counts = dict(zip(SHARES, (counted(model, data, share) for share in SHARES), strict=True))
        few, more = counts.values()
        whole = {key: few[key] + (more[key] - few[key]) / (SHARES[1] - SHARES[0]) * (1 - SHARES[0]) for key in more}
        asked = few["operations"] + few["kernels"]
        times = (bound(asked, whole, *card) for card in CARDS.values())
        batch = f"{data.batch_rays:,} rays" if data.sample_budget is None else f"{data.sample_budget:,} samples"
        row = batch, str(asked), f"{whole['bytes'] / 1e9:.2f}", f"{whole.get('flops', 0) / 1e12:.3f}", *times
        print(f"| {model} |", " | ".join(row), "|", flush=True)


def counted(model: str, data: Any, share: float) -> dict[str, int]:
    """Count the third step of a share of a batch, on a small occupancy grid; kernels do nothing."""
    budget = None if data.sample_budget is None else int(data.sample_budget * share)
    changes = [f"data.batch_rays={int(data.batch_rays * share)}", f"data.sample_budget={budget or 'null'}"]
    changes += [each for each in small(model) if "sampler.resolution" in each]
    with StandInDevice("cuda") as there, Launches(lambda *given, **options: None) as launches:
        run = step_by_step(model, there.device, "bf16-mixed", None, *changes)
        for _ in range(3):
            launches.counts.clear()
            run.step()
        return dict(launches.counts)


def bound(operations: int, whole: dict[str, float], bandwidth: float, teraflops: float) -> str:
    """Return milliseconds: what memory and arithmetic take, or beginning the operations, whichever is more."""
    on_device = max(whole["bytes"] / bandwidth / 1e9, whole.get("flops", 0) / teraflops / 1e12)
    low, high = (1e3 * max(on_device, operations * each * 1e-6) for each in LAUNCH)
    return f"{low:.1f}" if low == high else f"{low:.1f} to {high:.1f}"


if __name__ == "__main__":
    what, *named = sys.argv[1:] or [""]
    if what == "kernels":
        kernels(named or list(DEVICES))
    elif what == "steps":
        steps(named or [each for each in options("model") if each != "auto" and "transformer" not in each])
    else:
        sys.exit(__doc__)

"""Every kind of model trained and rendered on devices that are not there (`support.stand_in_device`).

Once a run is warm, no step may wait but where a function is named here, with how often. Pictures may: their rays are
followed in rounds, until none is left.
"""

from contextlib import nullcontext

import pytest
import torch
from support.configs import options
from support.gpu_training import small, step_by_step
from support.stand_in_device import StandInDevice

from nerf_lightning.nerf.kernels import backends
from nerf_lightning.nerf.models.masked_level import MaskedLevel
from nerf_lightning.nerf.models.ragged_level import RaggedLevel
from nerf_lightning.nerf.models.render_image import render_picture

NARROW = {"depth": 3, "width": 32, "skip": 2, "blocks": 2, "image_width": 16}
"""Of networks: how wide they are changes neither what waits nor where anything lies."""
WARM, STEPS = 2, 7  # the optimizer's state comes to be while a run gets warm, and numbers that are kept on the device
UPDATED = 4  # grids have been updated once
TILE_POINTS = 128

# At the first update the host reads which cells there are, and how large; it sends their numbers.
CELLS = {"OccupancySampler.learn": 3}
# At each update it asks whether samples were counted, and then how many a ray has, by which tiles are cut.
TALLY = {"RaggedLevel.on_step": 2, "RaggedLevel.points_per_ray": 2}
# In each step it reads where rays come from, how many photographs shall be looked at, and whether there are any; and
# which they are, since it is the host that holds them.
SOURCES = {"choose_sources": 3 * (STEPS - WARM), "ViewTransformer._looked_up": 2 * (STEPS - WARM)}
# Each of the 12 that are trained is sent once, when it is first looked at.
SENT, PHOTOGRAPHS = "ViewTables._pictures.<locals>.make", 12

# `auto` is `fast` until a scene is read; of the others that are left out a smaller one runs the same code.
SAME = ("auto", "fast", "fast_large", "nerf", "nerf_small", "view_transformer")
MODELS = [name for name in options("model") if name not in SAME]
SINGLE = ("fast_small", "nerf_tiny")  # in float32, too


def marked(*case):
    """All but one are left to make test-slow."""
    return pytest.param(*case, marks=() if case == ("fast_small", "bf16-mixed") else pytest.mark.minutes)


def run_on(there, model, precision):
    looks = model.startswith("view_transformer")  # by whole batches, so that what it reads can be counted
    return step_by_step(model, there.device, precision, None if looks else TILE_POINTS, *small(model, **NARROW))


def named_waits(model):
    """Return how often functions may wait in the steps after the first."""
    parts = {type(part) for part in model.modules()}
    of_grids = CELLS if parts & {RaggedLevel, MaskedLevel} else {}
    return of_grids | (TALLY if RaggedLevel in parts else {}) | (SOURCES if model.needs_photographs else {})


def step_and_render(there, run, waits):
    for step in range(STEPS):
        if step < WARM:
            run.step()
        else:
            with there.in_step(*waits):
                run.step()
    render_picture(run.training.objective.model.eval(), run.training.objective.rays, 0, "white", 1 << 14)
    assert bool(run.all_losses().isfinite().all())


def losses_on_the_cpu(model):
    run = step_by_step(model, torch.device("cpu"), "32-true", TILE_POINTS, *small(model, **NARROW))
    for _ in range(STEPS):
        run.step()
    return run.all_losses().tolist()


@pytest.mark.parametrize(
    ("model", "precision"),
    [marked(model, "bf16-mixed") for model in MODELS] + [marked(model, "32-true") for model in SINGLE],
)
def test_steps_on_cuda_wait_where_it_is_named_alone(model, precision):
    with StandInDevice("cuda") as there, backends.without("hash_grid.cuda", "mlp.cuda"):
        run = run_on(there, model, precision)
        waits = named_waits(run.training.objective.model)
        step_and_render(there, run, (*waits, SENT))
    assert there.waited.pop(SENT, 0) <= PHOTOGRAPHS
    assert there.waited == waits
    if precision == "32-true":
        assert run.all_losses().tolist() == pytest.approx(losses_on_the_cpu(model), rel=1e-5)


@pytest.mark.minutes
@pytest.mark.parametrize("model", MODELS)
def test_every_model_trains_and_renders_on_mps(model):
    with StandInDevice("mps") as there:
        run = run_on(there, model, "32-true")
        for _ in range(UPDATED):
            run.step()
        render_picture(run.training.objective.model.eval(), run.training.objective.rays, 0, "white", 1 << 14)
        assert bool(run.all_losses().isfinite().all())


BESIDE = {
    group: [option for option in options(group) if f"{group}={option}" not in ("correction=auto", "loss=proposal")]
    for group in ("correction", "refinement", "loss")
}


@pytest.mark.parametrize("kind", ["cuda", pytest.param("mps", marks=pytest.mark.minutes)])
@pytest.mark.parametrize("number", range(max(map(len, BESIDE.values()))))
def test_what_learns_beside_a_model_neither_waits_nor_lies_apart(number, kind):
    """An option of each group at a time."""
    parts = [f"{group}={offered[number % len(offered)]}" for group, offered in BESIDE.items()]
    with StandInDevice(kind) as there:
        run = step_by_step("nerf_tiny", there.device, "32-true", None, *small("nerf_tiny"), *parts)
        for _ in range(WARM):
            run.step()
        with there.in_step() if kind == "cuda" else nullcontext():  # which has one memory for both
            run.step()


class NoKernel:
    """In the place of a triton kernel: takes what lies on the device, and leaves a small number where results go."""

    def __init__(self, *results):
        self.results, self.launched = results, 0

    def __getitem__(self, grid):
        def launch(*arguments, **options):
            assert all(each.is_cuda for each in arguments if isinstance(each, torch.Tensor))
            for result in self.results:
                arguments[result].fill_(1e-3)
            self.launched += 1

        return launch


@pytest.mark.parametrize("model", ["fast_small", "fast_proposal"])
def test_what_starts_the_cuda_kernels_does_not_wait(model, monkeypatch):
    pytest.importorskip("triton")
    from nerf_lightning.nerf.kernels.hash_grid import cuda as hash_grid
    from nerf_lightning.nerf.kernels.mlp import cuda as mlp

    kernels = {hash_grid: (NoKernel(6), NoKernel(0)), mlp: (NoKernel(4, 5), NoKernel(5, 6))}
    for module, (forward, backward) in kernels.items():
        monkeypatch.setattr(module, "_forward", forward)
        monkeypatch.setattr(module, "_backward", backward)
    known = {module.__name__: module for module in (hash_grid, mlp)}
    monkeypatch.setattr(backends, "backend", known.get)
    with StandInDevice("cuda") as there:
        run = run_on(there, model, "bf16-mixed")
        step_and_render(there, run, named_waits(run.training.objective.model))
    assert all(kernel.launched >= STEPS for pair in kernels.values() for kernel in pair)

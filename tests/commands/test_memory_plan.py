"""The memory plan against the memory that a run really takes, measured in a process of its own."""

import json
import logging
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from support.configs import composed, options
from support.scenes import ball_scene

from nerf_lightning.commands.train_job import fit, memory_plan
from nerf_lightning.commands.train_job.memory_plan import MemoryPlan, Row
from nerf_lightning.commands.train_job.memory_trial import peak_bytes
from nerf_lightning.config.instantiate import build
from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.training.build_step import build_step
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.step import TrainStep

CPU = torch.device("cpu")
TILE = 131_072

MEASURE = """
import ctypes, json, sys

sys.path.insert(0, sys.argv[1])
import torch
from support.configs import composed
from support.scenes import ball_scene

from nerf_lightning.config.instantiate import build; from nerf_lightning.training.build_step import build_step
from nerf_lightning.commands.train_job.memory_plan import memory_plan
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.evaluation.metrics import image_metrics
from nerf_lightning.nerf.models.ragged_level import average_counts
from nerf_lightning.nerf.models.render_image import render_picture
from nerf_lightning.nerf.part import reset_statistics

TILE = int(sys.argv[3])
THREADS = int(sys.argv[4])


def status(name):
    with open("/proc/self/status") as file:
        return 1024 * int(next(line for line in file if line.startswith(name)).split()[1])


def most(work):
    "Bytes that the work adds to what is there."
    ctypes.CDLL("libc.so.6").malloc_trim(0)  # what was freed before would be taken again
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")  # the peak is what there is now
    before = status("VmRSS")
    work()
    return status("VmHWM") - before


def built():
    progress = Progress()
    train_step = build_step(config, settings, scene, progress)
    settings.prepare(train_step.objective.model)
    train_step.tiles.points, train_step.num_steps = TILE, 10
    return train_step, build(config.data)(scene=scene, progress=progress, seed=0)


def warm(train_step, batches):
    "Load libraries and kernels, which are in no plan."
    few = batches.at(0, 0)[:8]
    train_step.gradients(few, train_step.key)
    with torch.no_grad():
        train_step.objective.model(train_step.objective.rays(few.pixels), None, None)
        image_metrics(torch.rand(16, 16, 3), torch.rand(16, 16, 3))
    train_step.objective.zero_grad(set_to_none=True)
    reset_statistics(train_step.objective)
    average_counts(train_step.objective.model)


def train():
    for _ in range(2):
        batches.progress.batch_rays = batches.progress.largest_batch
        train_step(batches.at(0, batches.progress.rays_seen), optimizer)


def evaluate():
    train_step.objective.model.eval()
    with torch.no_grad():
        picture = render_picture(train_step.objective.model, train_step.objective.rays, 0, "white", TILE)
        image_metrics(picture.rgb, picture.rgb)


asked = [f"model={sys.argv[2]}", "trainer.accelerator=cpu", f"trainer.num_threads={THREADS}"]
config = composed("train", *asked, *sys.argv[5:])
settings = build(config.trainer)
settings.prepare_machine()
scene = ball_scene(num_views=6, size=320, background="random")
settings.tile_points = TILE
train_step, data = built()
batches, optimizer = data.batches, train_step.new_optimizer()
warm(train_step, batches)
measured = most(lambda: (train(), evaluate()))
plan = memory_plan(settings, *built())
print(plan)
gaps = sum(row.num_bytes for row in plan.rows if row.what.startswith("gaps"))
print(json.dumps([measured, plan.total, gaps]))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the peak of the resident memory is read from /proc")
@pytest.mark.parametrize(
    ("model", "precision", "threads", "overrides"),
    [
        pytest.param("nerf_tiny", "bf16-mixed", 2, ["data.batch_rays=4096"], marks=pytest.mark.minutes),
        pytest.param("nerf_tiny", "bf16-mixed", 1, ["data.batch_rays=4096"], marks=pytest.mark.exhaustive),
        pytest.param("fast_proposal", "bf16-mixed", 1, [], marks=pytest.mark.exhaustive),
        pytest.param("nerf_tiny", "32-true", 2, ["data.batch_rays=4096"], marks=pytest.mark.exhaustive),
        pytest.param("fast_small", "32-true", 1, [], marks=pytest.mark.exhaustive),
        pytest.param("fast_small", "bf16-mixed", 1, [], marks=pytest.mark.exhaustive),
        pytest.param("fast_proposal", "32-true", 2, [], marks=pytest.mark.exhaustive),
    ],
)
def test_the_plan_is_right_to_a_fifth(model, precision, threads, overrides):
    tests = str(Path(__file__).parents[1])
    settings = [f"trainer.precision={precision}", *overrides]
    # In a process of its own: a fork fills the gaps in the heap that it was born with.
    command = [sys.executable, "-c", MEASURE, tests, model, str(TILE), str(threads), *settings]
    seen = []
    for _ in range(5):  # the gaps in the heap make one run take a fifth more than another of the same program
        run = subprocess.run(command, check=True, capture_output=True, text=True)
        print(run.stdout)
        measured, planned, gaps = json.loads(run.stdout.splitlines()[-1])
        # What the plan counts for gaps is between none and twice as much: where there are none, the rest is right.
        if 0.8 * measured < planned and planned - gaps < 1.2 * measured:
            return
        seen.append(measured)
    pytest.fail(f"planned {planned}, of which {gaps} for gaps, measured {seen}")


def test_what_a_chain_of_layers_holds_is_counted_to_the_byte_and_views_take_nothing():
    weight, points = torch.randn(8, 8, requires_grad=True), torch.randn(1000, 8)

    def forward():
        hidden = points
        for _ in range(3):
            hidden = torch.nn.functional.linear(hidden, weight)
        return hidden

    layer = 1000 * 8 * 4
    with torch.no_grad():
        assert peak_bytes(forward, CPU) == 2 * layer  # one goes in, one comes out
    assert peak_bytes(forward, CPU) == 3 * layer  # the way back needs what lies between
    assert peak_bytes(forward, torch.device("meta")) == 0
    before = torch.zeros(1000)
    assert peak_bytes(lambda: before.view(10, 100).t().add_(1.0), CPU) == 0
    assert peak_bytes(lambda: before + 1.0, CPU) == 4000


def built_for(name, threads, tile):
    torch.set_num_threads(threads)
    config = composed("train", f"model={name}", "trainer.accelerator=cpu", f"trainer.tile_points={tile}")
    views = 24 if name.startswith("view_transformer") else 4  # each is rendered from up to ten others
    scene, progress, settings = ball_scene(num_views=views, size=32), Progress(), build(config.trainer)
    train_step = build_step(config, settings, scene, progress)
    settings.prepare(train_step.objective.model)
    train_step.num_steps = 10
    return settings, train_step, build(config.data)(scene=scene, progress=progress, seed=0)


def test_tiles_beside_each_other_are_there_at_once():
    """What other threads allocate is seen by no watcher: it was planned as nothing."""
    one, two = (memory_plan.memory_plan(*built_for("nerf_tiny", n, 4096)).instead[0].num_bytes for n in (1, 2))
    assert 1.5 * one < two < 2.2 * one


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in ("nerf_tiny", "fast_large") else pytest.mark.exhaustive)
        for name in options("model")
        if name != "auto"
    ],
)
def test_no_plan_exceeds_what_is_known_without_a_trial(name):
    parts = built_for(name, 2, 8192)
    assert memory_plan.memory_plan(*parts).total < memory_plan.at_most(*parts)


def plan(step, free, counts=True):
    rows = [Row("pixels", 3 * 10**9, "mapped file", counts), Row("optimizer", 10**9, "memory", cure="shrink it")]
    steps = [Row("a step", step, "memory", cure="lower trainer.tile_points"), Row("a picture", 10**9, "memory")]
    return MemoryPlan(rows, steps, free)


def test_the_total_counts_what_is_there_at_a_time_and_a_shortage_is_said_with_its_cure():
    assert plan(2 * 10**9, 10**10).total == 6 * 10**9
    assert plan(10**8, 10**10).total == 5 * 10**9
    assert plan(2 * 10**9, 10**10, counts=False).total == 3 * 10**9
    assert "at most" in str(plan(2 * 10**9, 10**10)).splitlines()[-1]
    assert plan(2 * 10**9, 7 * 10**9).warning is None
    assert "lower trainer.tile_points" in str(plan(4 * 10**9, 7 * 10**9).warning)
    assert "7.0 GB are free" in str(plan(4 * 10**9, 7 * 10**9).warning)


def announced(monkeypatch, caplog, level, free):
    plan = MemoryPlan([Row("pixels", 10**9, "memory")], [Row("a step", 2 * 10**9, "memory")], free=free)
    monkeypatch.setattr(memory_plan, "memory_plan", lambda *parts: plan)
    monkeypatch.setattr(memory_plan, "at_most", lambda *parts: 10**15)
    settings, train_step, data = (kind.__new__(kind) for kind in (TrainerSettings, TrainStep, RayDataModule))
    settings.device_type = "cpu"
    with caplog.at_level(level, "nerf_lightning"):
        memory_plan.announce_memory(settings, train_step, data)
    return str(plan).splitlines(), caplog.messages


def test_a_plan_is_logged_row_by_row_for_who_asks(monkeypatch, caplog):
    """What is logged is escaped, ends of lines too."""
    rows, messages = announced(monkeypatch, caplog, logging.DEBUG, free=10**12)
    assert messages == rows
    assert len(messages) == 4


def test_a_plan_is_one_line_that_says_what_is_counted_and_not_mentioned_where_it_is_small(monkeypatch, caplog):
    _, messages = announced(monkeypatch, caplog, logging.INFO, free=10**10)
    assert len(messages) == 1
    assert messages[0].startswith("memory: at most about 3.0 GB on top of the ")
    assert "10.0 GB are free" in messages[0]
    caplog.clear()
    assert announced(monkeypatch, caplog, logging.INFO, free=10**12)[1] == []


def test_a_run_that_is_surely_small_is_not_tried(monkeypatch):
    def tried(*parts):
        raise AssertionError

    monkeypatch.setattr(memory_plan, "memory_plan", tried)
    monkeypatch.setattr(memory_plan, "free_memory", lambda device: 10**12)
    memory_plan.announce_memory(*built_for("nerf_tiny", 1, 8192))


@pytest.mark.parametrize(("steps", "measured"), [(2, []), (3, [8192])])
def test_a_short_run_does_not_measure(steps, measured, train, monkeypatch):
    asked = []
    monkeypatch.setattr(fit, "SHORT_RUN", 2)
    monkeypatch.setattr(fit, "measured_tile", lambda *given: asked.append(8192) or (8192, None))
    short = ("trainer.tile_points=auto", f"trainer.max_steps={steps}")
    result = train(*short, "final.evaluate=false", "final.video=false")
    assert result.code == 0, result.err
    assert asked == measured


@pytest.mark.parametrize(
    ("length", "line"),
    [
        (
            ("trainer.max_steps=90", "budget.seconds=null"),
            "time: 90 steps take about 3 h here (trainer.max_steps=90); ",
        ),
        (("budget.seconds=0.1",), "time: 200,000 steps, as published, take about 278 days here (trainer.max_steps="),
        (("trainer.max_steps=4", "budget.seconds=null"), None),
    ],
)
def test_hours_are_said_before_the_first_step(length, line, train, monkeypatch):
    monkeypatch.setattr(fit, "SHORT_RUN", 2)
    monkeypatch.setattr(fit, "measured_tile", lambda *given: (8192, 120.0))
    short = ("trainer.tile_points=auto", "final.evaluate=false", "final.video=false")
    result = train(*length, *short, "trainer.lightning.fast_dev_run=false")
    assert result.code == 0, result.err
    assert ("time: " in result.err) == (line is not None)
    assert (line or "") in result.err

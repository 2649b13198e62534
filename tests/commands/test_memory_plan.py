"""The bound of a run's memory against what a step and a picture really allocate."""

import logging

import pytest
import torch
from support.configs import composed, options
from support.peak_bytes import peak_bytes
from support.running import done
from support.scenes import ball_scene

from nerf_lightning.commands.train_job import fit, memory_plan
from nerf_lightning.commands.train_job.memory_plan import TAKEN, announce_memory, needs
from nerf_lightning.config.instantiate import build
from nerf_lightning.nerf.models.render_image import render_picture
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.training.build_step import build_step

CPU = torch.device("cpu")


def built_for(name, threads, tile):
    torch.set_num_threads(threads)
    config = composed("train", f"model={name}", "trainer.accelerator=cpu", f"trainer.tile_points={tile}")
    views = 24 if name.startswith("view_transformer") else 4  # each is rendered from up to ten others
    scene, progress, settings = ball_scene(num_views=views, size=32), Progress(), build(config.trainer)
    train_step = build_step(config, settings, scene, progress)
    settings.prepare(train_step.objective.model)
    train_step.num_steps = 10
    return settings, train_step, build(config.data)(scene=scene, progress=progress, seed=0)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in ("nerf_tiny", "fast_small") else pytest.mark.exhaustive)
        for name in options("model")
        if name != "auto"
    ],
)
def test_a_step_and_a_picture_take_less_than_half_of_the_bound(name):
    settings, train_step, data = built_for(name, 1, "null" if name == "nerf_tiny" else 8192)
    optimizer = train_step.new_optimizer()
    bound = sum(need.num_bytes for need in needs(settings, train_step, data))

    def work():
        batch = data.batches.batch_at(0, 0)
        train_step(batch, optimizer)
        with torch.no_grad():
            render_picture(train_step.objective.model, train_step.objective.rays, 0, "white", 8192)

    taken = peak_bytes(work, CPU)
    assert 0.0 < taken < TAKEN * bound


def announced(monkeypatch, caplog, level, free):
    monkeypatch.setattr(memory_plan, "free_memory", lambda device: free)
    caplog.clear()
    with caplog.at_level(level, "nerf_lightning.commands"):
        announce_memory(*built_for("nerf_tiny", 1, 8192))
    return caplog.messages


def test_the_parts_of_a_bound_are_details_and_a_shortage_is_warned_of_with_what_takes_most(monkeypatch, caplog):
    assert announced(monkeypatch, caplog, logging.INFO, 10**12) == []
    assert len(announced(monkeypatch, caplog, logging.DEBUG, 10**12)) == 5
    (warning,) = announced(monkeypatch, caplog, logging.INFO, 10**6)
    assert "but only 0.0 GB are free, so the system may stop it" in warning
    assert "the samples of a step: lower trainer.tile_points" in warning


@pytest.mark.parametrize(("steps", "measured"), [(2, []), (3, [8192])])
def test_a_short_run_does_not_measure(steps, measured, train, monkeypatch):
    asked = []
    monkeypatch.setattr(fit, "SHORT_RUN", 2)
    monkeypatch.setattr(fit, "measured_tile", lambda *given: asked.append(8192) or (8192, None))
    short = ("trainer.tile_points=auto", f"trainer.max_steps={steps}")
    done(train(*short, "final.evaluate=false", "final.video=false"))
    assert asked == measured


@pytest.mark.minutes
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
    result = done(train(*length, *short, "trainer.lightning.fast_dev_run=false"))
    assert ("time: " in result.err) == (line is not None)
    assert (line or "") in result.err

"""The fast path from the command line: resume and time budgets."""

import signal
import time

import pytest
import torch
from support.running import FAST, FAST_PATH, finished, output_of, saved, start
from support.systems import POSIX

QUIET = (*[x for x in FAST if not x.startswith(("model=", "data.batch", "data.crop"))], *FAST_PATH)
STEPS = 70


def arguments(capture, folder, *extra):
    return (
        "train", "scene=npz", f"scene.path={capture}", *QUIET, f"trainer.max_steps={STEPS}", "trainer.num_threads=1",
        "final.evaluate=false", "final.video=false", "resume=auto", "callbacks.checkpoints.every_steps=5",
        "callbacks.validation_pictures.every_steps=1000", f"paths.output_dir={folder}", *extra,
    )  # fmt: skip


def flat(value, path=""):
    """Every tensor and number of nested containers."""
    if isinstance(value, dict):
        for key, child in value.items():
            yield from flat(child, f"{path}.{key}")
    elif isinstance(value, (list, tuple)):
        for key, child in enumerate(value):
            yield from flat(child, f"{path}.{key}")
    elif isinstance(value, (int, float, torch.Tensor)):
        yield path, value


@pytest.mark.minutes
@pytest.mark.parametrize("threads", [1, pytest.param(2, marks=pytest.mark.exhaustive)])
@POSIX
def test_a_fast_run_that_is_killed_and_stopped_ends_with_the_same_bits(capture, tmp_path, threads):
    """Weights, moments, occupancy grid, rays per step and per pixel: all of it."""
    # Several rays a pixel from step 21 on: between the two places at which it is stopped.
    shared = (f"trainer.num_threads={threads}", "model.subpixels=2", "model.subpixels_from=0.3")
    output_of(start(*arguments(capture, tmp_path / "whole", *shared)))
    folder = tmp_path / "stopped"
    for how, after in ((signal.SIGKILL, 10), (signal.SIGTERM, 25)):
        process = start(*arguments(capture, folder, *shared))
        while process.poll() is None and saved(folder)["global_step"] < after:
            time.sleep(0.02)
        process.send_signal(how)
        code, output = finished(process)
        assert code in (-how, 128 + how), output
    output = output_of(start(*arguments(capture, folder, *shared)))
    assert "resuming from step" in output
    ours, theirs = saved(folder), saved(tmp_path / "whole")
    for part in ("global_step", "state_dict", "optimizer_states"):
        mine, other = dict(flat(ours[part])), dict(flat(theirs[part]))
        assert mine.keys() == other.keys()
        assert all(torch.equal(torch.as_tensor(mine[key]), torch.as_tensor(other[key])) for key in mine), part
    assert ours["nerf_lightning"]["progress"] == theirs["nerf_lightning"]["progress"]
    assert 0 < theirs["nerf_lightning"]["progress"]["batch_rays"] < 256  # it has adapted


@pytest.mark.slow
def test_a_time_budget_ends_the_run_and_its_schedule(capture, tmp_path):
    long = ("trainer.max_steps=1000000", "budget.seconds=2", "scheduler.cooldown=1.0")
    output = output_of(start(*arguments(capture, tmp_path / "run", *long)))
    content = saved(tmp_path / "run")
    assert 0 < content["global_step"] < 100_000  # a busy machine that compiles kernels on the way has few
    rate = content["optimizer_states"][0]["param_groups"][0]
    # The schedule has come to its end, of which a busy machine has few steps.
    assert rate["lr"] / rate["base_lr"] < 0.02 + 3 / content["global_step"]
    used = [state["used"] for state in content["callbacks"].values() if "used" in state]
    assert used
    assert used[0] >= 1.75
    assert "training: 2 s (budget.seconds), " in output
    assert f"{content['global_step']} steps in " in output

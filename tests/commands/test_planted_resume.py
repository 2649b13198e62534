"""The state that training goes on from, changed key by key: refused in words, before anything is computed with it."""

import os
import shutil

import pytest
import torch
from support.resumed import Resumed
from support.running import FAST_PATH

from nerf_lightning.messages.errors import InputError

HUGE = 10**10


@pytest.fixture(scope="module")
def resume(stopped, capture, tmp_path_factory):
    return Resumed(stopped, capture, tmp_path_factory.mktemp("gate")).take


@pytest.fixture(scope="module")
def resume_fast(stopped_fast, capture, tmp_path_factory):
    return Resumed(stopped_fast, capture, tmp_path_factory.mktemp("gate_fast"), *FAST_PATH).take


def run_state(**values):
    return lambda content: content["nerf_lightning"].update(values)


def progress(**values):
    return lambda content: content["nerf_lightning"]["progress"].update(values)


def top(**values):
    return lambda content: content.update(values)


def moments(**values):
    """Change what the optimizer keeps of the first parameter."""

    def change(content):
        entry = content["optimizer_states"][0]["state"][0]
        entry.update({key: value(entry[key]) for key, value in values.items()})

    return change


def group(**values):
    return lambda content: content["optimizer_states"][0]["param_groups"][0].update(values)


def weight(value):
    def change(content):
        key = next(key for key, tensor in content["state_dict"].items() if tensor.is_floating_point() and tensor.dim())
        content["state_dict"][key] = value(content["state_dict"][key])

    return change


def loop(*keys, value):
    def change(content):
        node = content["loops"]["fit_loop"]
        for key in keys[:-1]:
            node = node[key]
        node[keys[-1]] = value

    return change


def test_a_sound_one_is_taken(resume, resume_fast):
    resume(lambda content: None)
    resume_fast(lambda content: None)


CASES = {
    "no moments": (moments(exp_avg=lambda x: torch.zeros(1), exp_avg_sq=lambda x: torch.zeros(1)), "exp_avg"),
    "one moment": (moments(exp_avg=lambda x: torch.zeros(1)), "optimizer_states.0.exp_avg is not a tensor of the"),
    "int8 moments": (moments(exp_avg=lambda x: x.to(torch.int8)), "exp_avg holds torch.int8, not torch.float32"),
    "a moment of NaN": (moments(exp_avg=lambda x: x * float("nan")), "exp_avg holds NaN"),
    "negative squares": (moments(exp_avg_sq=lambda x: x - 1), "exp_avg_sq holds NaN, infinity, or what no optimizer"),
    "a step ahead": (moments(step=lambda x: x + 1000), "step is not a number from 0 to 12"),
    "a moment that is a word": (moments(exp_avg=lambda x: "x"), "exp_avg is not a tensor"),
    "no optimizer": (top(optimizer_states=[]), "optimizer_states has 0 entries"),
    "an optimizer without state": (
        lambda c: c["optimizer_states"][0]["state"].pop(3),
        "holds the state of",
    ),
    "another setting": (group(eps=0.5), "eps is not what the run's config says"),
    "a negative rate": (group(base_lr=-1.0), "base_lr is -1.0"),
    "a rate of NaN": (group(lr=float("nan")), "lr is nan"),
    "an unknown setting": (group(hook="os.system"), "has the settings"),
    "other parameters": (group(params=[0, 0]), "params is not what the run's config says"),
    "many threads": (run_state(num_threads=10**6), "num_threads is 1000000"),
    "no threads": (run_state(num_threads=-1), "num_threads is -1"),
    "a word for threads": (run_state(num_threads="x"), "num_threads is 'x'"),
    "many rays": (progress(batch_rays=HUGE), "batch_rays is 10000000000"),
    "other rays": (progress(batch_rays=63), "has 63 rays of 64 in a step"),
    "an attribute": (progress(advance=3), "progress holds 'advance'"),
    "steps ahead": (progress(step=13), "has come to what 12 steps cannot"),
    "rays ahead": (progress(rays_seen=HUGE), "progress.rays_seen is more than"),
    "no progress": (lambda c: c["nerf_lightning"].pop("progress"), "nerf_lightning lacks progress"),
    "bad steps": (run_state(bad_steps=[1, 2]), "bad_steps counts more in a row than in all"),
    "no loops": (top(loops={}), "loops lacks fit_loop"),
    "a loop of words": (loop("epoch_progress", value="x"), "loops.fit_loop.epoch_progress is 'x'"),
    "a loop ahead": (loop("epoch_loop.batch_progress", "total", "ready", value=HUGE), "has counted other batches"),
    "steps of the loop": (
        loop("epoch_loop.manual_optimization.optim_step_progress", "total", "completed", value=3),
        "has taken 3 steps",
    ),
    "no callbacks": (top(callbacks={}), "is missing"),
    "a callback's word": (lambda c: c["callbacks"]["CollapseGuard"].update(failed="x"), "CollapseGuard.failed is 'x'"),
    "another Lightning": (top(**{"pytorch-lightning_version": "zz"}), "pytorch-lightning_version is 'zz'"),
    "no tensor": (weight(lambda x: "x"), "is 'x', not a tensor of numbers"),
    "weights of NaN": (weight(lambda x: x * float("nan")), "holds NaN or infinity"),
    "complex weights": (weight(lambda x: x.to(torch.complex64)), "holds complex64"),
    "double weights": (weight(lambda x: x.double()), "holds torch.float64"),
    "weights of another shape": (weight(lambda x: x[:1]), "in the shape"),
    "an extra weight": (lambda c: c["state_dict"].update({"model.more": torch.zeros(1)}), "belongs to no part"),
    "a weight less": (lambda c: c["state_dict"].popitem(), "is missing"),
    "a schedule": (top(lr_schedulers=[{"x": 1}]), "lr_schedulers has 1 entries"),
    "a stranger's key": (top(stranger={"x": 1}), "holds 'stranger'"),
    "a negative step": (top(global_step=-1), "global_step is -1"),
}


@pytest.mark.parametrize(("change", "words"), CASES.values(), ids=CASES)
def test_what_no_run_leaves_is_named(resume, change, words):
    with pytest.raises(InputError) as refusal:
        resume(change)
    message = str(refusal.value)
    assert words in message, message
    assert "damaged, or made by somebody else" in message


def buffer(name, value):
    def change(content):
        key = next(key for key in content["state_dict"] if key.endswith(name))
        content["state_dict"][key] = value(content["state_dict"][key])

    return change


FAST_CASES = {
    "no moments": (moments(exp_avg=lambda x: torch.zeros(1)), "exp_avg is not a tensor of the shape"),
    "a step that is a tensor": (moments(step=lambda x: torch.tensor(3.0)), "step is not a number"),
    "a box inside out": (buffer("sampler.grid.aabb", lambda x: x.flip(0)), "box in the model's state"),
    "a field's box of a point": (buffer("field.aabb", lambda x: x * 0), "box in the model's state"),
    "cells": (buffer("sampler.grid.cells", lambda x: x + 7), "occupancy grid in the model's state"),
    "far before near": (buffer("sampler.grid.range", lambda x: x.flip(0)), "occupancy grid in the model's state"),
    "negative counts": (buffer("tally", lambda x: x - 10), "samples per ray"),
}


@pytest.mark.parametrize(("change", "words"), FAST_CASES.values(), ids=FAST_CASES)
def test_what_no_occupancy_grid_holds_is_named(resume_fast, change, words):
    with pytest.raises(InputError, match=words):
        resume_fast(change)


def test_the_command_refuses_and_leaves_the_checkpoint(nerf, stopped, tmp_path):
    """Fused Adam wrote beyond such moments: the process died of it, or its memory was another."""
    run = tmp_path / "run"
    shutil.copytree(stopped, run)
    last = run / "checkpoints" / "last.ckpt"
    content = torch.load(last, weights_only=True)
    CASES["no moments"][0](content)
    torch.save(content, last)
    before = last.read_bytes()
    result = nerf("train", f"resume={run}", "trainer.max_steps=25")
    assert result.code == 2
    assert result.err.splitlines()[-1].startswith("nerf: Training cannot go on: optimizer_states.0.exp_avg is not")
    assert "Traceback" not in result.err
    assert last.read_bytes() == before


def test_more_threads_than_cores_are_not_taken(resume, caplog):
    resume(run_state(num_threads=(os.cpu_count() or 1) + 1))
    assert "may differ in the last bits" in caplog.text

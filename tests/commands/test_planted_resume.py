"""The state that training goes on from, changed: refused in words, before anything is computed with it."""

import os
import shutil

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support.fuzzing import fuzzed, harmless
from support.mutations import mutated
from support.resumed import Resumed
from support.running import FAST_PATH, refused


@pytest.fixture(scope="module")
def resume(stopped, capture, tmp_path_factory):
    return Resumed(stopped, capture, tmp_path_factory.mktemp("gate")).take


@pytest.fixture(scope="module")
def resume_fast(stopped_fast, capture, tmp_path_factory):
    return Resumed(stopped_fast, capture, tmp_path_factory.mktemp("gate_fast"), *FAST_PATH).take


def at(*keys, value):
    """Change what stands at a place of a checkpoint; a function of what is there, or another value."""

    def change(content):
        for key in keys[:-1]:
            content = content[key]
        content[keys[-1]] = value(content[keys[-1]]) if callable(value) else value

    return change


OURS, OPTIMIZER = "nerf_lightning", ("optimizer_states", 0)
WEIGHT = ("state_dict", "model.levels.fine.field.feature.weight")
CASES = {
    "a weight less": (lambda c: c["state_dict"].popitem(), "is missing"),
    "another shape": (at(*WEIGHT, value=lambda x: x[:1]), "in the shape"),
    "weights of NaN": (at(*WEIGHT, value=lambda x: x * float("nan")), "holds NaN or infinity"),
    "short moments": (at(*OPTIMIZER, "state", 0, "exp_avg", value=torch.zeros(1)), "optimizer_states.0.exp_avg holds"),
    "infinite moments": (at(*OPTIMIZER, "state", 0, "exp_avg", value=lambda x: x / 0), "exp_avg holds NaN"),
    "another setting": (at(*OPTIMIZER, "param_groups", 0, "eps", value=0.5), "not what the run's config says"),
    "many rays": (at(OURS, "progress", "batch_rays", value=10**10), "has 10000000000 rays"),
    "many threads": (at(OURS, "num_threads", value=10**6), "num_threads is 1000000"),
    "no progress": (lambda c: c[OURS].pop("progress"), "nerf_lightning.progress is missing"),
    "an unknown key": (at("stranger", value={"x": 1}), "stranger belongs to no file of this kind"),
    "weights alone": (
        lambda c: [c.pop(key) for key in ("optimizer_states", "lr_schedulers")],
        "weights without the state",
    ),
    "a loop of words": (
        at("loops", "fit_loop", "epoch_progress", value="x"),
        "epoch_progress is 'x', not of the type dict",
    ),
    "other steps": (at("global_step", value=3), "has not taken the 3 steps"),
    "a callback's word": (at("callbacks", "CollapseGuard", "failed", value="x"), "CollapseGuard.failed is 'x'"),
    "another Lightning": (at("pytorch-lightning_version", value="zz"), "InvalidVersion"),
}


@pytest.mark.parametrize(("change", "words"), CASES.values(), ids=CASES)
def test_what_no_run_leaves_is_named(resume, change, words):
    refused(resume, change, parts=("last.ckpt", words))


def buffer(name, value):
    def change(content):
        key = next(key for key in content["state_dict"] if key.endswith(name))
        content["state_dict"][key] = value(content["state_dict"][key])

    return change


FAST_CASES = {
    "short moments": (at(*OPTIMIZER, "state", 0, "exp_avg", value=torch.zeros(1)), "exp_avg holds torch.float32 in"),
    "a step that is a tensor": (at(*OPTIMIZER, "state", 0, "step", value=torch.tensor(3.0)), "step is a Tensor"),
    "another space": (buffer("contracted.switch", torch.logical_not), "is not False"),
    "a box inside out": (buffer("sampler.grid.aabb", lambda x: x.flip(0)), "box in the model's state"),
    "cells": (buffer("sampler.grid.cells", lambda x: x + 7), "occupancy grid in the model's state"),
    "negative counts": (buffer("counts", lambda x: x - 10), "samples per ray"),
}


@pytest.mark.parametrize(("change", "words"), FAST_CASES.values(), ids=FAST_CASES)
def test_integers_that_index_memory_are_in_range(resume_fast, change, words):
    refused(resume_fast, change, parts=(words,))


def test_the_command_refuses_and_leaves_the_checkpoint(nerf, stopped, tmp_path):
    """Fused Adam wrote beyond such moments: the process died of it, or its memory was another."""
    run = tmp_path / "run"
    shutil.copytree(stopped, run)
    last = run / "checkpoints" / "last.ckpt"
    content = torch.load(last, weights_only=True)
    CASES["short moments"][0](content)
    torch.save(content, last)
    before = last.read_bytes()
    result = nerf("train", f"resume={run}", "trainer.max_steps=25")
    assert result.code == 2
    assert result.err.splitlines()[-1].startswith(
        f"nerf: {last} is damaged, or was made by somebody else: optimizer_states"
    )
    assert "Traceback" not in result.err
    assert last.read_bytes() == before


def test_a_sound_one_is_taken(resume, resume_fast, caplog):
    resume(lambda content: None)
    resume_fast(lambda content: None)
    resume(at(OURS, "num_threads", value=(os.cpu_count() or 1) + 1))  # more than there are cores
    assert "may differ in the last bits" in caplog.text


@fuzzed(40)
@given(st.data())
def test_a_damaged_one_is_refused_or_taken(resume_fast, data):
    def damage(content):
        changed = data.draw(mutated(content))
        content.clear()
        content.update(changed if isinstance(changed, dict) else {})

    harmless(resume_fast, damage)

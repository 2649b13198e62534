"""`nerf bench`: what it measures, and where it writes it."""

import json
from functools import partialmethod

import torch
from support.running import FAST_PATH, said
from support.tape import tape

from nerf_lightning.nerf.kernels.backends import CPU_BACKENDS, without
from nerf_lightning.nerf.kernels.threads import torch_on_one_thread
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.step import TrainStep


def test_bench_measures_a_packed_model(nerf, tmp_path, monkeypatch):
    threads, set_threads = [], torch.set_num_threads
    monkeypatch.setattr("nerf_lightning.extensions.bench.commands.bench.num_cores", lambda: 2)
    monkeypatch.setattr(torch, "set_num_threads", lambda count: (threads.append(count), set_threads(count)))
    result = nerf(
        "bench", "scene.resolution=24", "scene.num_train=6", "scene.num_val=2", "scene.num_test=1",
        f"scene.cache_dir={tmp_path}/cache", *FAST_PATH, "rounds=1", "warmup_steps=20", "render_rays=64",
        "trainer.tile_points=4096", f"paths.output_dir={tmp_path}/bench",
    )  # fmt: skip
    assert result.code == 0, result.err
    for name in ("training rays/s", "times plain", "whole rays, loss and gradients, share of a step"):
        assert name in result.out
    assert {1, 2} <= set(threads)
    measured = json.loads((tmp_path / "bench" / "bench.json").read_text())
    assert measured["training on 2 threads, times one"]["median"] > 0
    assert "share of a step that takes one thread alone" in measured
    assert measured["training_flops_per_ray"] > 0


def test_bench_replays_what_training_would_replay(nerf, tmp_path, monkeypatch):
    """`support.tape` stands for CUDA graphs, with the torch twins of the kernels."""
    monkeypatch.setattr(TrainerSettings, "records", lambda settings, step: True)
    monkeypatch.setattr(TrainStep, "record_gradients", partialmethod(TrainStep.record_gradients, record=tape))
    monkeypatch.setattr(OccupancySampler, "capacity_for", lambda sampler, rays: 8192)
    with without(*CPU_BACKENDS), torch_on_one_thread():
        result = nerf(
            "bench", "scene.resolution=16", "scene.num_train=4", "scene.num_val=1", "scene.num_test=1",
            f"scene.cache_dir={tmp_path}/cache", *FAST_PATH, "rounds=1", "warmup_steps=2", "render_rays=64",
            "scaling=false", f"paths.output_dir={tmp_path}/bench",
        )  # fmt: skip
    assert result.code == 0, result.err
    measured = json.loads((tmp_path / "bench" / "bench.json").read_text())
    assert measured["training, times kernels launched one by one"]["median"] > 0
    assert measured["training_flops_per_ray"] > 0
    assert not [name for name in measured if name.startswith("march")]  # a replay has no stages


def test_a_group_of_training_is_told_where_it_belongs(nerf):
    said(nerf("bench", "experiment=quickstart"), "nerf bench has no setting experiment. It belongs to training")


def test_bench_measures_what_training_would_choose(nerf, tmp_path):
    result = nerf(
        "bench", "model=auto", "scene.resolution=16", "scene.num_train=4", "scene.num_val=1",
        "scene.num_test=1", f"scene.cache_dir={tmp_path}/cache", "rounds=1", "render_rays=64", "scaling=false",
        "data.batch_rays=128", "data.sample_budget=2048", f"paths.output_dir={tmp_path}/bench",
    )  # fmt: skip
    assert result.code == 0, result.err
    assert "model: fast, because the scene is in a box" in result.err
    assert json.loads((tmp_path / "bench" / "bench.json").read_text())["batch_rays"] == 128

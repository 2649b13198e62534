"""`nerf bench`: what it measures, and where it writes the results."""

import json

import pytest
import torch
from support.running import FAST_PATH, said
from support.tape import steps_on_tape

from nerf_lightning.extensions.bench.prepared import Bench
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler


@pytest.fixture
def bench(nerf, tmp_path):
    """Measure one round of a small scene; return what is said, and what bench.json has."""

    def call(*settings):
        result = nerf(
            "bench", "scene.resolution=16", "scene.num_train=4", "scene.num_val=1", "scene.num_test=1",
            f"scene.cache_dir={tmp_path}/cache", "rounds=1", "render_rays=64", *settings,
            f"paths.output_dir={tmp_path}/bench",
        )  # fmt: skip
        assert result.code == 0, result.err
        return result, json.loads((tmp_path / "bench" / "bench.json").read_text())

    return call


@pytest.mark.minutes
def test_bench_measures_a_packed_model(bench, monkeypatch):
    tiles, train = [], Bench.train
    monkeypatch.setattr(
        Bench, "train", lambda self, steps: (tiles.append(self.train_step.tiles.points), train(self, steps))
    )
    threads, set_threads = [], torch.set_num_threads
    monkeypatch.setattr("nerf_lightning.extensions.bench.commands.bench.num_cores", lambda: 2)
    monkeypatch.setattr(torch, "set_num_threads", lambda count: (threads.append(count), set_threads(count)))
    result, measured = bench(
        *FAST_PATH, "scene.resolution=24", "scene.num_train=6", "scene.num_val=2", "warmup_steps=20",
        "trainer.tile_points=4096",
    )  # fmt: skip
    for name in ("training rays/s", "times plain", "whole rays, loss and gradients, share of a step"):
        assert name in result.out
    assert {1, 2} <= set(threads)
    assert set(tiles) == {4096}  # whatever plain rendering has done before
    assert measured["training on 2 threads, times one"]["median"] > 0
    assert "share of a step that takes one thread alone" in measured
    assert measured["training_flops_per_ray"] > 0


@pytest.mark.minutes
def test_bench_replays_what_training_would_replay(bench, monkeypatch):
    """`support.tape` stands for CUDA graphs, with the torch twins of the kernels."""
    monkeypatch.setattr(OccupancySampler, "capacity_for", lambda sampler, rays: 8192)
    with steps_on_tape() as replays:
        _, measured = bench(*FAST_PATH, "warmup_steps=2", "scaling=false")
    assert len(replays) == 2 + 1 + 2 * 2  # before; and two kinds in a discarded round and one that counts
    assert measured["training, times kernels launched one by one"]["median"] > 0
    assert measured["training_flops_per_ray"] > 0
    assert not [name for name in measured if name.startswith("march")]  # a replay has no stages


def test_a_group_of_training_is_told_where_it_belongs(nerf):
    said(nerf("bench", "experiment=quickstart"), "nerf bench has no setting experiment. It belongs to training")


def test_bench_measures_what_training_would_choose(bench):
    result, measured = bench("model=auto", "scaling=false", "data.batch_rays=128", "data.sample_budget=2048")
    assert "model: fast, because the scene is in a box" in result.err
    assert measured["batch_rays"] == 128

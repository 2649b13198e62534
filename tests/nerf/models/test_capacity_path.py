"""What GPUs do with ragged samples, without one: a fixed capacity."""

import pytest
import torch
from support.configs import composed
from support.scenes import ball_scene

from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.nerf.kernels.backends import without
from nerf_lightning.nerf.kernels.threads import torch_on_one_thread
from nerf_lightning.nerf.part import statistics
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.selftest.training import METHODS
from nerf_lightning.training.build_step import build_step
from nerf_lightning.training.launch.trainer import TrainerSettings

STATIC = (
    "model.levels.fine.sampler._target_=support.static_models.StaticSampler",
    "+model.levels.fine.sampler.capacity=32768",
)


@pytest.fixture(autouse=True)
def _samples_are_packed():
    """Without the CPU's kernels that render whole rays, and in one tile: GPUs have none, and do not share it out."""
    with without("render.cpu", "render.gradients"), torch_on_one_thread(shares_out=False):
        yield


def trained(steps, capacity=None):
    scene, progress = ball_scene(num_views=8, size=16, background="random"), Progress()
    config = composed("train", "model=fast_small", *METHODS["fast_small"], *(STATIC if capacity else ()))
    train_step = build_step(config, TrainerSettings(100, accelerator="cpu", precision="32-true"), scene, progress)
    train_step.num_steps = 100
    if capacity:
        train_step.objective.model.last.sampler.capacity = capacity
    loader, optimizer = RayBatches(scene, progress, 0, 64), train_step.new_optimizer()
    losses = [train_step(loader.at(0, progress.rays_seen), optimizer).losses for _ in range(steps)]
    assert train_step.guard.skipped == 0
    return losses[-1], statistics(train_step.objective.model)["train/dropped_samples"]


def test_with_room_for_all_samples_the_capacity_changes_nothing_but_rounding():
    (free, none), (fixed, dropped) = trained(20), trained(20, capacity=32768)
    torch.testing.assert_close(free, fixed, rtol=1e-3, atol=0)
    assert none == dropped == 0


def test_without_room_samples_are_dropped_and_counted():
    assert trained(3, capacity=500)[1] > 500

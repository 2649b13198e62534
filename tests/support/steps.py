"""Steps of a tiny model."""

import torch
from support.scenes import ball_scene, tiny_model

from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.nerf.losses.mse import MeanSquaredError
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.objective import Objective
from nerf_lightning.nerf.optimizers.schedule import ExponentialDecay
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.training.attempts import draw_weights
from nerf_lightning.training.step import TrainStep


class NoUpdate(torch.optim.SGD):
    """Takes no step, so that gradients can be looked at."""

    def __init__(self, groups):
        super().__init__(groups, lr=1.0)

    def step(self, closure=None):
        pass


def rays_of(scene) -> RayGenerator:
    """What makes the rays of a scene's views."""
    return RayGenerator(scene.cameras, scene.near, scene.far)


def make_step(tile_points, model=None, background="white", clip_norm=None, seed=0, sample_budget=None):
    """The step of a tiny model on the ball, whose weights nothing moves."""
    train_step = TrainStep(
        objective=Objective(
            model or tiny_model(density_bias=0.5), rays_of(ball_scene()), MeanSquaredError(), background
        ),
        optimizer=NoUpdate,
        schedule=ExponentialDecay(decay_rate=1.0, decay_steps=1),
        progress=Progress(),
        num_steps=100,
        seed=seed,
        tile_points=tile_points,
        clip_norm=clip_norm,
        sample_budget=sample_budget,
    )
    draw_weights(train_step)
    return train_step


def gradients(train_step, scene, steps=1):
    """The gradients and the losses of the last of some steps."""
    loader, optimizer = RayBatches(scene, train_step.progress, 0, 64), train_step.new_optimizer()
    for _ in range(steps):
        seen = train_step(loader.batch_at(0, train_step.progress.rays_seen), optimizer)
    return torch.cat([p.grad.flatten() for p in train_step.objective.model.parameters()]), seen.losses

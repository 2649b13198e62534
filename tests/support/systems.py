"""A system of a tiny model, whose steps are taken without a trainer."""

import torch
from support.scenes import tiny_model

from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.nerf.losses.mse import MeanSquaredError
from nerf_lightning.nerf.optimizers.schedule import ExponentialDecay
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.training.system import RadianceFieldSystem


class StubOptimizer:
    """Stands in for Lightning's wrapper: counts, does not update."""

    def __init__(self, parameters):
        self.param_groups = [{"lr": 1.0, "params": list(parameters)}]

    def zero_grad(self):
        for parameter in self.param_groups[0]["params"]:
            parameter.grad = None

    def step(self):
        pass


def make_system(tile_points, model=None, background="white", clip_norm=None, seed=0, sample_budget=None):
    system = RadianceFieldSystem(
        model=model or tiny_model(density_bias=0.5),
        loss=MeanSquaredError(),
        optimizer=torch.optim.Adam,
        schedule=ExponentialDecay(decay_rate=1.0, decay_steps=1),
        progress=Progress(),
        num_steps=100,
        seed=seed,
        background=background,
        tile_points=tile_points,
        clip_norm=clip_norm,
        sample_budget=sample_budget,
        record={},
    )
    optimizer = StubOptimizer(system.parameters())
    system.optimizers = lambda: optimizer
    system.manual_backward = lambda loss: loss.backward()
    return system


def gradients(system, scene, steps=1):
    loader = RayBatches(scene, system.progress, 0, 64, 10)
    for _ in range(steps):
        system.training_step(loader.at(0, system.progress.rays_seen), 0)
    return torch.cat([p.grad.flatten() for p in system.model.parameters()]), system.last_step["losses"]

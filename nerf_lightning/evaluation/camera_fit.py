"""Test cameras of a run that refined its cameras: each is fitted to its photograph before it is scored.

Where training cameras were wrong and have moved, those of the test views are just as wrong and have not. The score
should be of the scene, not of the pose file, so each test camera takes some steps on its own photograph with all
weights frozen (as BARF, arXiv 2104.06405, and Nerfies do); the protocol of the numbers says so.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import torch

from nerf_lightning.nerf.losses.mse import MeanSquaredError
from nerf_lightning.nerf.matmul_precision import disable_autocast
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.tiles import pixels_in_tile, tiles
from nerf_lightning.nerf.objective import Objective
from nerf_lightning.nerf.part import sample_counts
from nerf_lightning.nerf.refinements.se3 import SE3Delta
from nerf_lightning.nerf.types.rays import Batch, PixelIndex
from nerf_lightning.nerf.types.scene import Background, Cameras, Scene

NUM_STEPS = 60
STEP_RAYS = 1024
FIRST_RATE, LAST_RATE = 3e-3, 1e-4


@torch.enable_grad()
@disable_autocast
def fitted_camera(model: Model, scene: Scene, view: int, background: Background, tile_points: int) -> Cameras:
    """Return the scene's (refined) cameras, with that of `view` fitted to its photograph.

    The model is in evaluation mode, and its weights and counts do not change; at most `tile_points` points go through a
    field at once.
    """
    device = next(model.parameters()).device
    motion = SE3Delta(weight=0.0)
    motion.learn(scene.cameras[view : view + 1], scene.aabb, photographs=1)
    near, far = scene.near[view : view + 1], scene.far[view : view + 1]
    rays_of = RayGenerator(scene.cameras[view : view + 1], near, far, motion).to(device)
    optimizer = torch.optim.Adam(motion.parameters(), lr=FIRST_RATE)
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, (LAST_RATE / FIRST_RATE) ** (1.0 / NUM_STEPS))
    objective = Objective(model, rays_of, MeanSquaredError(), background)
    rgba, kept = scene.pixels.view(view), scene.pixels.view_mask(view)
    shown = None if kept is None or not bool(kept.any()) else kept.flatten().nonzero()[:, 0]
    count, width = rgba[..., 0].numel() if shown is None else len(shown), rgba.shape[1]
    draw = torch.Generator().manual_seed(view)
    with _frozen(model):
        for _ in range(NUM_STEPS):
            number = torch.randint(count, (min(STEP_RAYS, count),), generator=draw)
            number = number if shown is None else shown[number]
            x, y = number % width, number // width
            optimizer.zero_grad()
            pixels = PixelIndex(torch.zeros_like(x), x, y)
            batch = Batch(pixels, rgba[y, x].float() / 255.0, torch.ones(len(x))).to(device)
            for part in tiles(len(x), pixels_in_tile(model, tile_points, training=True)):
                renderings, target = objective.neutral(batch[part])
                (
                    objective.loss(renderings[-1:], target)["color"].sum() * ((part.stop - part.start) / len(x))
                ).backward()
            optimizer.step()
            decay.step()
    c2w = scene.cameras.c2w.clone()
    c2w[view] = rays_of.cameras.c2w.detach().cpu()[0]
    return replace(scene.cameras, c2w=c2w)


@contextmanager
def _frozen(model: Model) -> Iterator[None]:
    """Keep a model from learning and counting anything within the context."""
    learning = [parameter for parameter in model.parameters() if parameter.requires_grad]
    counts = [count.clone() for count in sample_counts(model)]
    try:
        for parameter in learning:
            parameter.requires_grad_(False)
        yield
    finally:
        for parameter in learning:
            parameter.requires_grad_(True)
        for count, before in zip(sample_counts(model), counts, strict=True):
            count.copy_(before)

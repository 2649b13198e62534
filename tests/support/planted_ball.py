"""Bricks with a passer-by: a shaded ball at another place in each training photograph."""

from dataclasses import replace

import torch

from nerf_lightning.nerf.types.scene import Scene


def with_jumping_ball(scene: Scene, radius: float = 0.14, seed: int = 0) -> Scene:
    """Return the scene with an opaque ball painted into each training photograph; the others stay as they are.

    Args:
        scene: with photographs in memory.
        radius: of the ball, as a share of the photograph's shorter side.
        seed: of the places.
    """
    generator = torch.Generator().manual_seed(seed)
    rgba = scene.pixels.rgba.clone()
    painted = replace(scene.pixels, rgba=rgba)
    for view in scene.splits["train"]:
        picture = painted.view(view)
        height, width = picture.shape[:2]
        size = radius * min(width, height)
        middle = size + (torch.tensor([width, height]) - 2 * size) * torch.rand(2, generator=generator)
        y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
        across, down = (x - middle[0]) / size, (y - middle[1]) / size
        towards = (1.0 - across.square() - down.square()).clamp(min=0.0).sqrt()
        # Lit from the upper left, of one color in all photographs.
        light = (0.25 + 0.75 * (0.7 * towards - 0.5 * across - 0.5 * down).clamp(0.0, 1.0))[..., None]
        ball = torch.cat([light * torch.tensor([0.2, 0.9, 0.3]), torch.ones(height, width, 1)], dim=-1)
        inside = across.square() + down.square() < 1.0
        picture[inside] = (255 * ball[inside]).round().to(torch.uint8)
    return replace(scene, pixels=painted)

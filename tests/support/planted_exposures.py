"""Scenes whose photographs were exposed differently, by gains that are known."""

from dataclasses import replace

import torch
from torch import Tensor

from nerf_lightning.nerf.rendering.linear_light import scale_light
from nerf_lightning.nerf.types.scene import Scene


def random_stops(num_views: int, seed: int = 0) -> Tensor:
    """Exposures from -1 to 1 stop, and gains of red and blue from -20 % to 20 %, which cancel out on the whole."""
    generator = torch.Generator().manual_seed(seed)
    stops = torch.rand(num_views, 3, generator=generator) * 2 - 1
    stops -= stops.mean(dim=0)
    return stops / stops.abs().amax(dim=0) * torch.tensor([1.0, 0.26, 0.26])


def with_stops(scene: Scene, stops: Tensor, dim: float = 1.0) -> Scene:
    """Return the scene with the light of all photographs dimmed, and that of those that train scaled.

    Args:
        scene: the scene.
        stops: of each training view: exposure, red, blue.
        dim: factor on the light of all, which leaves room to expose some longer.
    """
    gains = torch.full((len(scene.view_names), 3), dim)
    exposure, red, blue = stops.unbind(-1)
    shift = torch.stack([exposure + red, exposure - red - blue, exposure + blue], dim=-1)
    gains[list(scene.splits["train"])] *= torch.exp2(shift)
    rgba = scene.pixels.rgba.clone()
    for view, gain in enumerate(gains):
        part = slice(
            int(scene.pixels.offset[view]), int(scene.pixels.offset[view]) + scene.pixels.view(view)[..., 0].numel()
        )
        shown = scale_light(rgba[part, :3].float() / 255.0, gain)
        rgba[part, :3] = (shown.clamp(0, 1) * 255.0).round().to(torch.uint8)
    return replace(scene, pixels=replace(scene.pixels, rgba=rgba))

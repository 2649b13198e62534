"""Rays of a batch through pixels of known distance, from sparse points or a depth sensor."""

from dataclasses import replace

import torch
from jaxtyping import Int
from torch import Tensor

from nerf_lightning.nerf.types.rays import Batch, PixelIndex
from nerf_lightning.nerf.types.scene import Scene


class DepthRays:
    """The pixels of known distance in training views, numbered from 0, or square patches around them.

    Args:
        scene: with depths.
        patch: side of the patches in pixels.
    """

    def __init__(self, scene: Scene, patch: int = 1):
        assert scene.depths is not None
        device = scene.pixels.width.device
        trained = torch.isin(scene.depths.pixels.view, torch.tensor(scene.splits["train"]))
        self.depths, self.patch = scene.depths[trained.nonzero()[:, 0]].to(device), patch
        self.width, self.height = scene.pixels.width, scene.pixels.height

    def __len__(self) -> int:
        return len(self.depths)

    def locate(self, number: Int[Tensor, "squares"]) -> PixelIndex:
        """Return the pixels of the squares, row by row, with the known one in the middle if the view allows."""
        pixels = self.depths.pixels[number]
        if self.patch == 1:
            return pixels
        inside = torch.arange(self.patch, device=number.device)
        down, across = (part.flatten() for part in torch.meshgrid(inside, inside, indexing="ij"))
        x, y = (
            (at - self.patch // 2).clamp(min=0).minimum(size[pixels.view] - self.patch)
            for at, size in ((pixels.x, self.width), (pixels.y, self.height))
        )
        return PixelIndex(
            view=pixels.view[:, None].expand(-1, len(down)).flatten(),
            x=(x[:, None] + across).flatten(),
            y=(y[:, None] + down).flatten(),
        )

    def with_depths(self, batch: Batch, number: Int[Tensor, "squares"]) -> Batch:
        """Return a batch with the distances of its last squares, from `locate`; its other rays have no certainty."""
        known, size = self.depths[number], self.patch**2
        distance, certainty = torch.ones_like(batch.weight), torch.zeros_like(batch.weight)
        last = batch.num_rays - len(number) * size
        own = batch.pixels[last:].map(lambda each: each.view(-1, size))
        here = (own.x == known.pixels.x[:, None]) & (own.y == known.pixels.y[:, None])
        distance[last:] = known.distance.repeat_interleave(size)
        certainty[last:] = (known.certainty[:, None] * here).flatten()
        return replace(batch, distance=distance, certainty=certainty * batch.weight)

"""A picture's pixels in quads: adjacent 2 x 2 pixels are consecutive, so that their rays can share work."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.nerf.types.scene import Cameras

QUAD = 4
"""Pixels per quad."""


def pixels_in_quads(height: int, width: int) -> int:
    """Return the number of pixels in a picture's quads: those of an odd last row or column count twice.

    >>> pixels_in_quads(3, 2)
    8
    """
    return QUAD * -(-height // 2) * -(-width // 2)


def quads_between(cameras: Cameras, view: int, part: slice) -> PixelIndex:
    """Return a range of pixels of one view, numbered quad by quad from 0."""
    number = torch.arange(part.start, part.stop, device=cameras.c2w.device)
    width, height = int(cameras.width[view]), int(cameras.height[view])
    quad, corner, across = number // QUAD, number % QUAD, -(-width // 2)
    x, y = 2 * (quad % across) + corner % 2, 2 * (quad // across) + corner // 2
    return PixelIndex(view=torch.full_like(number, view), x=x.clamp(max=width - 1), y=y.clamp(max=height - 1))


def from_quads(pixels: Float[Tensor, "pixels *values"], height: int, width: int) -> Float[Tensor, "_ _ *values"]:
    """Return the picture of a view whose pixels are numbered quad by quad."""
    down, across, values = -(-height // 2), -(-width // 2), pixels.shape[1:]
    picture = pixels.view(down, across, 2, 2, *values).transpose(1, 2).reshape(2 * down, 2 * across, *values)
    return picture[:height, :width].contiguous()

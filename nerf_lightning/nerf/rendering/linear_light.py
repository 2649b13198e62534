"""Scaling light in encoded colors (sRGB, IEC 61966-2-1).

Letters: encoded color x, linear light v, gain g. v = x / 12.92 up to x = 0.04045, ((x + 0.055) / 1.055)^2.4 above.
The curves extend beyond [0, 1]: the linear one below 0, the power above 1.
"""

import torch
from jaxtyping import Float
from torch import Tensor

KNEE, SLOPE, OFFSET, POWER = 0.04045, 12.92, 0.055, 2.4


def to_linear(rgb: Float[Tensor, "*colors"]) -> Float[Tensor, "*colors"]:
    """Return the linear light of encoded colors, v(x).

    >>> to_linear(torch.tensor([0.0, 0.5, 1.0]))
    tensor([0.0000, 0.2140, 1.0000])
    """
    above = rgb > KNEE
    power = ((torch.where(above, rgb, 1.0) + OFFSET) / (1.0 + OFFSET)) ** POWER
    return torch.where(above, power, rgb / SLOPE)


def scale_light(rgb: Float[Tensor, "*colors"], gain: Float[Tensor, "*#colors"]) -> Float[Tensor, "*colors"]:
    """Return the encoded colors of g times the light of encoded colors, x(g v(x)).

    If both colors are on the power's part, this is s (x + 0.055) - 0.055 with s = g^(1/2.4), and if both are on the
    linear part, g x: written this way, a gain of 1 changes no bit of the colors or their gradients.

    Args:
        rgb: encoded colors, in [0, 1] or beyond.
        gain: factor on the light, > 0.

    >>> scale_light(torch.tensor([0.25, 0.5]), torch.tensor(2.0))
    tensor([0.3521, 0.6858])
    """
    s = gain ** (1.0 / POWER)
    bright = rgb > KNEE
    scaled = torch.where(bright, rgb * s + OFFSET * (s - 1.0), rgb * gain)
    stays = scaled > KNEE
    darkened = _straight(torch.where(bright & ~stays, rgb, 1.0), gain)
    brightened = _power(torch.where(~bright & stays, rgb, KNEE), gain)
    return torch.where(bright == stays, scaled, torch.where(bright, darkened, brightened))


def _straight(bright: Tensor, gain: Tensor) -> Tensor:
    return SLOPE * gain * ((bright + OFFSET) / (1.0 + OFFSET)) ** POWER


def _power(dark: Tensor, gain: Tensor) -> Tensor:
    return (1.0 + OFFSET) * (gain * dark / SLOPE) ** (1.0 / POWER) - OFFSET

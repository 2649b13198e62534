"""What is done to photographs before the image network, against exposures and tones that differ between them."""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

ImageNorm = Literal["none", "instance", "neurn"]
PATCH = 3
"""Side in pixels of the squares whose deviation is taken."""
LEAST_DEVIATION = 1e-6
"""Deviations below it, which only rounding makes of colours in [0, 1], count as none."""


def normalized(
    pictures: Float[Tensor, "views 3 height width"], kind: ImageNorm
) -> Float[Tensor, "views 3 height width"]:
    """Return pictures as the image network sees them.

    Args:
        pictures: colours in [0, 1].
        kind: `none` shifts them to [-1, 1]; `instance` gives each channel of each picture mean 0 and deviation 1;
            `neurn` is `local_deviation`.
    """
    if kind == "neurn":
        return local_deviation(pictures)
    if kind == "instance":
        return functional.instance_norm(pictures)
    return 2.0 * pictures - 1.0


def local_deviation(
    pictures: Float[Tensor, "*views channels height width"], patch: int = PATCH
) -> Float[Tensor, "*views channels height width"]:
    """Return the standard deviation around each pixel over the picture's largest, channel by channel, in [0, 1].

    NeuRN (arXiv 2505.06894), after neurons that answer to contrast. It is unchanged by gain and offset of a channel,
    and 0 where all is of one colour. Beyond the border the outermost pixels are repeated.
    """
    flat = pictures.reshape(-1, *pictures.shape[-3:])
    around = functional.pad(flat, (patch // 2,) * 4, mode="replicate").unfold(-2, patch, 1).unfold(-2, patch, 1)
    # Not as a difference of means of squares, which has no digits where little differs.
    apart = around - around.mean(dim=(-2, -1), keepdim=True)
    deviation = apart.square().mean(dim=(-2, -1)).sqrt()
    deviation = torch.where(deviation > LEAST_DEVIATION, deviation, 0.0)
    largest = deviation.amax(dim=(-2, -1), keepdim=True)
    return (deviation / largest.clamp(min=LEAST_DEVIATION)).view_as(pictures)

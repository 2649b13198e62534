"""Sines and cosines of doubling frequencies: the positional encoding of the original NeRF.

The numbers of octaves, and `with_pi`, are in conf/encoder/frequency*.yaml.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.encoders.base import Encoder
from nerf_lightning.nerf.ranges import require_ranges

MOST_FREQUENCIES = 64
"""Higher ones lose all digits in float32, and finally overflow."""


class FrequencyEncoder(Encoder):
    """gamma(x) = (x, sin(2^0 x), cos(2^0 x), ..., sin(2^(L-1) x), cos(2^(L-1) x)), Eq. 4 of arXiv 2003.08934.

    The paper has a factor pi inside the sines, its released code does not; without it a scene of a few units fits into
    one period of the lowest frequency. L = 10 for positions and 4 for directions.

    Args:
        num_frequencies: L, the number of octaves.
        include_input: whether the input itself comes first.
        with_pi: whether frequencies have the paper's factor pi.
    """

    frequencies: Tensor

    def __init__(self, num_frequencies: int = 10, include_input: bool = True, with_pi: bool = False):
        super().__init__()
        require_ranges({"num_frequencies": num_frequencies}, {"num_frequencies": (0, MOST_FREQUENCIES)})
        self.include_input = include_input
        scale = math.pi if with_pi else 1.0
        self.register_buffer("frequencies", scale * 2.0 ** torch.arange(num_frequencies), persistent=False)

    @property
    def out_dim(self) -> int:
        """Return 3 (2 L + 1) with the input, 6 L without."""
        return self.in_dim * (2 * self.frequencies.numel() + int(self.include_input))

    def forward(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points features"]:
        """Return the features, frequency by frequency."""
        phase = points[..., None, :] * self.frequencies.to(points.dtype)[:, None]
        waves = torch.stack([phase.sin(), phase.cos()], dim=-2).flatten(-3)
        return torch.cat([points, waves], dim=-1) if self.include_input else waves

    def reset_parameters(self) -> None:
        """Do nothing: there are no parameters."""

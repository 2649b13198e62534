"""Random Gaussian Fourier features (Tancik et al., NeurIPS 2020, arXiv 2006.10739)."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.encoders.base import Encoder


class GaussianFourierEncoder(Encoder):
    """gamma(x) = (cos(2 pi B x), sin(2 pi B x)) with the entries of B drawn once from N(0, scale^2) (Sec. 4).

    Unlike the axis-aligned frequencies of the original NeRF, the directions of B are isotropic. B is not learnt; it
    travels in the checkpoint.

    Args:
        num_frequencies: rows of B; there are twice as many features.
        scale: standard deviation of the frequencies in cycles per scene unit; larger resolves finer detail, and too
            large brings noise.
    """

    frequencies: Tensor

    def __init__(self, num_frequencies: int = 128, scale: float = 2.0):
        super().__init__()
        self.scale = scale
        self.register_buffer("frequencies", torch.empty(num_frequencies, 3))
        self.reset_parameters()

    @property
    def out_dim(self) -> int:
        """2 num_frequencies."""
        return 2 * self.frequencies.shape[0]

    def forward(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points features"]:
        """Return the cosines, then the sines."""
        # Elementwise, not a matrix product: in bfloat16 the phase would lose its digits.
        phase = 2 * torch.pi * (points[..., None, :] * self.frequencies.to(points.dtype)).sum(dim=-1)
        return torch.cat([phase.cos(), phase.sin()], dim=-1)

    def reset_parameters(self) -> None:
        """Draw B anew."""
        torch.nn.init.normal_(self.frequencies, std=self.scale)

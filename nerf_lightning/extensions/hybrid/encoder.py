"""Frequency features with learned factors for coarse scales, and a hash grid for fine scales (Hyb-NeRF)."""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nerf_lightning.nerf.encoders.base import ConeEncoder, Encoder
from nerf_lightning.nerf.encoders.frequency import FrequencyEncoder
from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.kernels.mlp.op import mlp
from nerf_lightning.nerf.ranges import require_ranges

CONE_OCTAVES = 4
VECTOR = 16
"""Kernels for small perceptrons take inputs of whole vectors; zeros pad them."""


class HybridEncoder(ConeEncoder):
    """(alpha gamma(x), h(x)): gamma of sines and cosines, h of a hash grid, alpha = tanh(MLP(h, cone)), per feature.

    After Hyb-NeRF (arXiv 2311.12490, WACV 2024), whose sizes are from other sources. Sines and cosines of low
    frequencies need no tables, and the factor makes them depend on the position: where the grid has learned that a
    frequency is absent, it is switched off.

    Args:
        coarse: features of the coarse scales, gamma.
        fine: hash grid of the fine scales, h; None: no grid.
        factor: the factor of the coarse features: `learnt`, as above, or `one`, which leaves them unchanged.
        width: width of the two hidden layers of the factor's MLP.
        cones: whether the factor also depends on the covariance of the pixel's cone, in squares of the grid's finest
            cell.

    Raises:
        ValueError: a learned factor without a grid, or cones without a learned factor.
    """

    needs_unit_cube = True

    def __init__(
        self,
        coarse: Encoder,
        fine: HashGridEncoder | None,
        factor: Literal["learnt", "one"] = "learnt",
        width: int = 64,
        cones: bool = False,
    ):
        super().__init__()
        require_ranges({"width": width}, {"width": (1, 1 << 20)})
        if factor == "learnt" and fine is None:
            raise ValueError("fine=null leaves nothing to learn the factor from: give a hash grid, or factor=one")
        if cones and factor == "one":
            raise ValueError("cones=true with factor=one: the learned factor is what sees cones; leave one of them out")
        self.coarse, self.fine, self.factor, self.sees_cones = coarse, fine, factor, cones
        self.cone = FrequencyEncoder(CONE_OCTAVES, include_input=False)
        self.factor_mlp = nn.ParameterList()
        if factor == "learnt" and fine is not None:
            seen = fine.out_dim + (2 * self.cone.out_dim if cones else 0)
            sizes = [(width, seen), (width, width), (coarse.out_dim, width)]
            self.factor_mlp.extend(torch.empty(size) for size in sizes)
        self.reset_parameters()

    @property
    def out_dim(self) -> int:
        """Features of the coarse scales plus those of the fine scales."""
        return self.coarse.out_dim + (0 if self.fine is None else self.fine.out_dim)

    def forward(
        self, points: Float[Tensor, "*points 3"], covariance: Float[Tensor, "*points 6"] | None = None
    ) -> Float[Tensor, "*points features"]:
        """Return the weighted coarse features, followed by the fine ones.

        Args:
            points: in the unit cube.
            covariance: of the pixels' cones (`geometry.cones`), in units of the cube; None: the points' own features,
                the limit of ever thinner cones.
        """
        return self._joined(points, None if self.fine is None else self.fine(points), covariance)

    def attach_gradients(
        self,
        points: Float[Tensor, "*points 3"],
        features: Float[Tensor, "*points features"],
        covariance: Float[Tensor, "*points 6"] | None = None,
    ) -> Float[Tensor, "*points features"]:
        """Return the features of points with gradients; values looked up in the grid are reused."""
        if not torch.is_grad_enabled():
            return features
        fine = None
        if self.fine is not None:
            fine = self.fine.attach_gradients(points, features[..., self.coarse.out_dim :].contiguous())
        return self._joined(points, fine, covariance)

    def reset_parameters(self) -> None:
        """Reinitialize every parameter from torch's generator."""
        self.coarse.reset_parameters()
        if self.fine is not None:
            self.fine.reset_parameters()
        for weight in self.factor_mlp:
            nn.init.kaiming_uniform_(weight, a=5**0.5)

    def _joined(self, points: Tensor, fine: Tensor | None, covariance: Tensor | None) -> Tensor:
        coarse = self.coarse(points)
        if fine is None:
            return coarse
        if self.factor == "learnt":
            coarse = self._factor(fine, covariance) * coarse
        return torch.cat([coarse, fine.to(coarse.dtype)], dim=-1)

    def _factor(self, fine: Tensor, covariance: Tensor | None) -> Tensor:
        seen = [fine]
        if self.sees_cones:
            seen.append(self._encoded_cone(fine.new_zeros(*fine.shape[:-1], 6) if covariance is None else covariance))
        first, *others = self.factor_mlp
        missing = -first.shape[1] % VECTOR
        inputs = torch.cat([*seen, fine.new_zeros(*fine.shape[:-1], missing)], dim=-1)
        weights = [functional.pad(first, (0, missing)), *others]
        raw = mlp(inputs.reshape(-1, inputs.shape[-1]), weights, self.matmul_precision)
        return torch.tanh(raw.to(fine.dtype)).view(*fine.shape[:-1], raw.shape[-1])

    def _encoded_cone(self, covariance: Tensor) -> Tensor:
        assert self.fine is not None  # else no factor depends on it
        entries = covariance * float(self.fine.layout.resolutions[-1]) ** 2
        # A distant cone is many cells wide; how many does not matter.
        entries = entries / (1.0 + entries.abs())
        return self.cone(entries.unflatten(-1, (2, 3))).flatten(-2)

"""The photometric loss of the original NeRF (Eq. 6, arXiv 2003.08934)."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import mse_loss

from nerf_lightning.nerf.losses.base import Loss
from nerf_lightning.nerf.types.rays import Target
from nerf_lightning.nerf.types.renderings import Rendering


class MeanSquaredError(Loss):
    """Mean squared error of the color, every level alike, so that the coarse level learns where to look."""

    def forward(self, renderings: list[Rendering], target: Target) -> dict[str, Float[Tensor, "levels"]]:
        """Return the weighted mean over rays and channels, per level."""
        return {"color": torch.stack([squared_error(rendering.rgb, target) for rendering in renderings])}


def squared_error(rgb: Float[Tensor, "rays 3"], target: Target) -> Float[Tensor, ""]:
    """Return the mean squared error of colors, weighted over rays, over rays and channels."""
    return (mse_loss(rgb, target.rgb, reduction="none") * target.weight[..., None]).mean()

"""The photometric loss of the original NeRF (Eq. 6, arXiv 2003.08934)."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import mse_loss

from nerf_lightning.nerf.losses.base import Loss
from nerf_lightning.nerf.types.rays import Target
from nerf_lightning.nerf.types.renderings import Rendering


class MeanSquaredError(Loss):
    """Mean squared error of the color, equally for every level, so that the coarse level learns where to look."""

    def forward(self, renderings: list[Rendering], target: Target) -> dict[str, Float[Tensor, "levels"]]:
        """Return the weighted mean over rays and channels, per level."""
        return {"color": squared_errors(renderings, target)}


def squared_errors(renderings: Sequence[Rendering], target: Target) -> Float[Tensor, "levels"]:
    """Return each level's mean squared error of colors over weighted rays and channels."""
    rgb = torch.stack([rendering.rgb for rendering in renderings])
    errors = mse_loss(rgb, target.rgb.expand_as(rgb), reduction="none")
    return (errors * target.weight[..., None]).mean(dim=(1, 2))

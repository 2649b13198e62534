"""Photographs with different exposure and white balance.

When it is used: `conf/correction/auto.yaml`, by the doctor's check in `doctor/image_quality.py`.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerf_lightning.nerf.corrections.base import Correction
from nerf_lightning.nerf.ranges import require_ranges
from nerf_lightning.nerf.rendering.linear_light import scale_light
from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.nerf.types.scene import SceneRecord


class Exposure(Correction):
    """One exposure per photograph, and the gains of red and blue relative to it, all in stops of linear light.

    The exposure is the mean of the three channels: green gains what red and blue lose.

    The light of all photographs can be scaled together, and the model's inversely: a penalty on the three means over
    the training photographs keeps them near zero, so that the neutral picture is exposed like the mean photograph.

    Args:
        learning_rate: learning rate of the exposures, in stops; Adam changes each by at most about this per step.
        mean_weight: weight of the sum of the squared means in the loss.
    """

    trained: Tensor

    def __init__(self, learning_rate: float = 1e-2, mean_weight: float = 1.0):
        super().__init__()
        require_ranges(locals(), {"learning_rate": (1e-8, 1.0), "mean_weight": (0.0, 1e6)})
        self.learning_rate, self.mean_weight = learning_rate, mean_weight
        self.stops = nn.Parameter(torch.zeros(1, 3))
        """Exposure, red and blue of each view."""
        self.register_buffer("trained", torch.zeros(1, dtype=torch.int64), persistent=False)

    def fit_to(self, scene: SceneRecord) -> None:
        """Allocate parameters for each photograph.

        Raises:
            InputError: there is only one.
        """
        super().fit_to(scene)
        self.stops = nn.Parameter(torch.zeros(len(scene.view_names), 3))
        self.trained = torch.tensor(scene.splits["train"])

    def forward(self, rgb: Float[Tensor, "*rays 3"], pixels: PixelIndex) -> Float[Tensor, "*rays 3"]:
        """Return the colors with their light scaled by the gains of their photographs."""
        return scale_light(rgb, self.gains()[pixels.view])

    def neutral(self, rgb: Float[Tensor, "*rays 3"], pixels: PixelIndex) -> Float[Tensor, "*rays 3"]:
        """Return the colors with their light divided by the gains of their photographs."""
        return scale_light(rgb, 1.0 / self.gains()[pixels.view])

    def gains(self) -> Float[Tensor, "views 3"]:
        """Return the factors on the linear light of red, green and blue in each photograph."""
        exposure, red, blue = self.stops.unbind(-1)
        return torch.exp2(torch.stack([exposure + red, exposure - red - blue, exposure + blue], dim=-1))

    def penalty(self) -> Float[Tensor, ""]:
        """Return `mean_weight` times the sum of squared means of the three stops over the training photographs."""
        return self.mean_weight * self.stops[self.trained].mean(dim=0).square().sum()

    def reset_parameters(self) -> None:
        """Reset all exposures to zero."""
        nn.init.zeros_(self.stops)

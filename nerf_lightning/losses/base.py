"""The contract of a loss: what the levels saw against what the photograph shows."""

from abc import ABC, abstractmethod

from jaxtyping import Float
from torch import Tensor, nn

from nerf_lightning.types import Rendering


class Loss(nn.Module, ABC):
    """A loss that is a mean over rays, so that the losses of tiles add up to that of the batch."""

    @abstractmethod
    def forward(self, renderings: list[Rendering], target: Float[Tensor, "*rays 3"]) -> list[Float[Tensor, ""]]:
        """Return one number per level, first level first; training minimises their sum."""

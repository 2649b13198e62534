"""The contract of a loss: what the levels saw against what the photograph shows."""

from abc import ABC, abstractmethod
from typing import Any

from jaxtyping import Float
from torch import Tensor, nn


class Loss(nn.Module, ABC):
    """A loss that is a mean over rays, so that the losses of tiles add up to that of the batch."""

    every_level_is_a_picture: bool = True
    """Whether each level's number is a squared error of colour; else only the last one's is."""

    @abstractmethod
    def forward(self, renderings: list[Any], target: Float[Tensor, "*rays 3"]) -> list[Float[Tensor, ""]]:
        """Return one number per level, first level first; training minimises their sum."""

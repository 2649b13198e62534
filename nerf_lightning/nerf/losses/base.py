"""The contract of a loss: renderings of the levels compared with photographs, as a sum of named terms."""

from abc import ABC, abstractmethod
from typing import Any

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.part import Part
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.types.rays import RayBundle, Target


class Loss(Part, ABC):
    """A weighted mean over rays, so that the losses of tiles add up to the batch's.

    The weights have a mean of 1 over the batch: a ray's value is multiplied by its weight before the plain mean.
    Dividing by the sum of a tile's own weights would let tiles with few unmasked rays count too much.
    """

    patch: int = 1
    """Side in pixels of the square patches that the loss needs: batches hold one after another, row by row."""

    depth_every: int = 0
    """One in this many rays of a batch goes through a pixel whose distance is known; 0: no such rays are added."""

    needs_weights: bool = False
    """Whether the loss uses the weights and samples of renderings, which levels may omit otherwise."""

    def rays_to_render(self, rays: RayBundle, target: Target, random: RayRandom | None) -> tuple[RayBundle, Target]:
        """Return the rays to render instead of those through a batch's pixels, and their target.

        Args:
            rays: rays through the pixels, as the model takes them.
            target: what the photographs show there.
            random: the step's random numbers for these rays; None: nothing is drawn.
        """
        return rays, target

    @abstractmethod
    def forward(self, renderings: list[Any], target: Target) -> dict[str, Float[Tensor, "levels"]]:
        """Return named terms, each with a number per level; training minimizes the sum of all, and logs each.

        Args:
            renderings: one per level.
            target: what the photographs show, how much each ray counts, and its photograph and pixel.
        """

"""The contract of a loss: what the levels saw against what the photographs show, as a sum of named terms."""

from abc import ABC, abstractmethod
from typing import Any

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.part import Part
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.types.rays import RayBundle, Target


class Loss(Part, ABC):
    """A weighted mean over rays, so that the losses of tiles add up to that of the batch.

    The weights come with a mean of 1 over the batch: a ray's number is multiplied by its weight before the plain mean.
    Dividing by the sum of a tile's own weights would let tiles with few unmasked rays count too much.
    """

    patch: int = 1
    """Side in pixels of the squares that it wants to see whole: batches hold one after the other, row by row."""

    depth_every: int = 0
    """One of so many rays of a batch runs through a pixel whose distance is known; 0: those are no special rays."""

    needs_weights: bool = False
    """Whether it looks at the weights and samples of renderings, which levels may leave out otherwise."""

    def rays_to_render(self, rays: RayBundle, target: Target, random: RayRandom | None) -> tuple[RayBundle, Target]:
        """Return the rays whose renderings it looks at, in place of those through a batch's pixels, and their target.

        Args:
            rays: through the pixels, as the model takes them.
            target: what the photographs show there.
            random: the step's numbers for these rays; None: nothing is drawn.
        """
        return rays, target

    @abstractmethod
    def forward(self, renderings: list[Any], target: Target) -> dict[str, Float[Tensor, "levels"]]:
        """Return named terms, each with a number per level; training minimizes the sum of all, and logs each.

        Args:
            renderings: one per level.
            target: what the photographs show, how much each ray counts, and where in which photograph it lies.
        """

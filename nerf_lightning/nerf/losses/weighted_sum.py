"""Several losses at once, each with its own weight and curve."""

from typing import Any

from jaxtyping import Float
from torch import Tensor, nn

from nerf_lightning.nerf.losses.base import Loss
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.types.rays import RayBundle, Target


class WeightedSum(Loss):
    """Add up named losses.

    Args:
        terms: name -> loss. Losses on patches of pixels must agree on their size.
        weights: name -> factor; 1 for a loss that is not named.

    Raises:
        ValueError: a weight without a loss, or patches of several sizes.
    """

    def __init__(self, terms: dict[str, Loss], weights: dict[str, float] | None = None):
        super().__init__()
        self.terms, self.weights = nn.ModuleDict(terms), dict(weights or {})
        if unknown := sorted(self.weights.keys() - terms.keys()):
            raise ValueError(f"weights names {unknown[0]}, which is not a loss: there are {', '.join(terms)}")
        sides = {loss.patch for loss in terms.values()} - {1}
        if len(sides) > 1:
            raise ValueError(f"the losses look at squares of {sorted(sides)} pixels a side: give all the same patch")
        self.patch = max([1, *sides])
        self.depth_every = min((each.depth_every for each in terms.values() if each.depth_every), default=0)
        self.needs_weights = any(loss.needs_weights for loss in terms.values())

    def rays_to_render(self, rays: RayBundle, target: Target, random: RayRandom | None) -> tuple[RayBundle, Target]:
        """Return the rays of all losses, applied one after another."""
        for loss in self.terms.values():
            if isinstance(loss, Loss):
                rays, target = loss.rays_to_render(rays, target, random)
        return rays, target

    def forward(self, renderings: list[Any], target: Target) -> dict[str, Float[Tensor, "levels"]]:
        """Return the terms of all losses times their weights; several terms of one loss as `name_term`."""
        found: dict[str, Tensor] = {}
        for name, loss in self.terms.items():
            terms = loss(renderings, target)
            for term, values in terms.items():
                found[name if len(terms) == 1 else f"{name}_{term}"] = self.weights.get(name, 1.0) * values
        return found

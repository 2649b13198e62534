"""The contract of a sampler: where along each ray to ask the field."""

from abc import ABC, abstractmethod

from torch import nn

from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.types.rays import RayBundle, RaySamples
from nerf_lightning.nerf.types.renderings import DenseRendering
from nerf_lightning.nerf.types.scene import Scene


class AnySampler(nn.Module):
    """What chooses where along rays to ask the field, in whatever layout."""

    max_intervals: int = 1 << 17
    """So many steps at most are taken along a ray: near and far may come out of a file."""

    def fit_to(self, scene: Scene) -> None:
        """Take note of where the scene's content lies, once, before training; a checkpoint carries it."""


class Sampler(AnySampler, ABC):
    """Choose intervals along rays, as many on each."""

    @abstractmethod
    def forward(self, rays: RayBundle, history: list[DenseRendering], random: RayRandom | None) -> RaySamples:
        """Return the intervals.

        Args:
            rays: near and far bound the intervals.
            history: what the earlier levels saw, coarse first; empty for the first level.
            random: the step's numbers for these rays; None asks for the deterministic midpoints of evaluation.
        """

    @abstractmethod
    def num_samples_after(self, before: int) -> int:
        """Return how many intervals come out, given how many the level before had (0 for none)."""

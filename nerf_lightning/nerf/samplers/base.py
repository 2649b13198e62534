"""The contracts of samplers: where along rays a field is evaluated, equally often on each ray or only where needed."""

from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.nerf.kernels.march.grid import GridMarch
from nerf_lightning.nerf.part import Part
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.types.rays import RaggedSamples, RayBundle, RaySamples
from nerf_lightning.nerf.types.renderings import DenseRendering

DensityFn = Callable[[Float[Tensor, "points 3"]], Float[Tensor, "points"]]
"""A function from positions to a field's density (per unit length)."""
OPAQUE_BELOW = 1e-3
"""Rays end where their transmittance falls below this, unless a sampler's `opaque_below` says otherwise."""


class Sampler(Part):
    """Chooses where along rays a field is evaluated, in any layout."""

    max_intervals: int = 1 << 17
    """Maximum number of steps along a ray: near and far may come from a file."""

    def reached_density(self, density: DensityFn, positions: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        """Return the density where rays sample; 0 where they skip, whatever the field says."""
        return density(positions)


class DenseSampler(Sampler, ABC):
    """Choose intervals along rays, equally many on each."""

    @abstractmethod
    def forward(self, rays: RayBundle, history: list[DenseRendering], random: RayRandom | None) -> RaySamples:
        """Return the intervals.

        Args:
            rays: the rays, whose near and far bound the intervals.
            history: the earlier levels' renderings, coarse first; empty for the first level.
            random: the step's random numbers for these rays; None selects the deterministic midpoints of evaluation.
        """

    @abstractmethod
    def num_samples_after(self, before: int) -> int:
        """Return the number of intervals, given that of the previous level (0 for none)."""


class RayMarcher(ABC):
    """Rays on their way through the scene while a picture is rendered, a chunk of samples at a time."""

    @abstractmethod
    def advance(self, alive: Int[Tensor, "alive"], limit: int) -> tuple[RaggedSamples, Bool[Tensor, "alive"]]:
        """Return the next samples of some of the rays, at most about `limit` each, and which rays have more."""

    def grid_march(self) -> GridMarch | None:
        """Return the whole march, for kernels that do all of it; None if it does not use a grid."""
        return None


class RaggedSampler(Sampler, ABC):
    """Choose intervals along rays, only where there may be something: their number differs from ray to ray."""

    opaque_below: float = OPAQUE_BELOW
    """A ray's samples end where its transmittance falls below this; 0 keeps them all."""
    found_per_visible: int = 4
    """Approximate number of samples found per visible one, after a minute of training (instant-ngp expects 16)."""
    update_every: int = 16
    """Training steps between two updates, during which a level counts the samples of rays."""
    sample_budget: int | None = None
    """Approximate number of samples per training step; None: as many as its rays have."""

    @property
    @abstractmethod
    def samples_at_first(self) -> int:
        """Assumed number of samples per ray until they have been counted."""

    def learn(self, density: DensityFn, step: int, key: int) -> None:
        """Learn from the field between steps of training.

        Args:
            density: the field's density.
            step: steps taken in this attempt.
            key: key of the next step's random numbers.
        """

    @abstractmethod
    def forward(self, rays: RayBundle, random: RayRandom | None) -> RaggedSamples:
        """Return the intervals that may hold something; `random` is None outside of training."""

    def capacity_for(self, rays: RayBundle) -> int | None:
        """Return the size of the arrays of visible samples if no size may be read on the host; else None.

        The arrays that `forward` returns may be larger.
        """
        return None

    def grid_march(self, rays: RayBundle, random: RayRandom | None) -> GridMarch | None:
        """Return the march of `forward`, for kernels that do all of it; None if it does not use a grid."""
        return None

    def marcher(self, rays: RayBundle) -> RayMarcher:
        """Start rendering rays; by default all samples come in one chunk."""
        return _OneChunk(self, rays)


class _OneChunk(RayMarcher):
    def __init__(self, sampler: RaggedSampler, rays: RayBundle):
        self.sampler, self.rays = sampler, rays

    def advance(self, alive: Int[Tensor, "alive"], limit: int) -> tuple[RaggedSamples, Bool[Tensor, "alive"]]:
        """Return all samples of these rays."""
        return self.sampler(self.rays[alive], None), torch.zeros_like(alive, dtype=torch.bool)

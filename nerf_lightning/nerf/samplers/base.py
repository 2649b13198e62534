"""The contracts of samplers: where along each ray a field is asked, as often on each ray, or only where it matters."""

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
"""A field's density (per unit length) at positions."""


class Sampler(Part):
    """What chooses where along rays a field is asked, in whatever layout."""

    max_intervals: int = 1 << 17
    """So many steps at most are taken along a ray: near and far may come out of a file."""

    def reached_density(self, density: DensityFn, positions: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        """Return the density where rays look for it; 0 where they pass over, whatever the field says."""
        return density(positions)


class DenseSampler(Sampler, ABC):
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


class RayMarcher(ABC):
    """Rays on their way through the scene while a picture is rendered, a chunk of samples at a time."""

    @abstractmethod
    def advance(self, alive: Int[Tensor, "alive"], limit: int) -> tuple[RaggedSamples, Bool[Tensor, "alive"]]:
        """Return the next samples of some of the rays, about `limit` each at most, and which rays have more of them."""

    def grid_march(self) -> GridMarch | None:
        """Return the whole march, for kernels that do all of it; None where it goes through no grid."""
        return None


class RaggedSampler(Sampler, ABC):
    """Choose intervals along rays, only where there may be something: their number differs from ray to ray."""

    opaque_below: float = 1e-3
    """A ray's samples end where less light than this is left; 0 keeps them all."""
    found_per_visible: int = 4
    """So many samples are found for each visible one, about: after a minute of training (instant-ngp expects 16)."""
    update_every: int = 16
    """Training steps between two updates; meanwhile a level counts how many samples rays have."""
    sample_budget: int | None = None
    """Samples of a training step, about; None: as many as its rays have."""

    @property
    @abstractmethod
    def samples_at_first(self) -> int:
        """How many samples a ray is taken to have until they have been counted."""

    def learn(self, density: DensityFn, step: int, key: int) -> None:
        """Learn from the field between steps of training.

        Args:
            density: the field's.
            step: steps that this attempt has taken.
            key: of the next step's random numbers.
        """

    @abstractmethod
    def forward(self, rays: RayBundle, random: RayRandom | None) -> RaggedSamples:
        """Return the intervals that may hold something; `random` is None outside of training."""

    def capacity_for(self, rays: RayBundle) -> int | None:
        """Return the size of the arrays of visible samples where no size may be read on the host; None elsewhere.

        The arrays that `forward` returns may be larger.
        """
        return None

    def grid_march(self, rays: RayBundle, random: RayRandom | None) -> GridMarch | None:
        """Return the march that `forward` takes, for kernels that do all of it; None where it goes through no grid."""
        return None

    def marcher(self, rays: RayBundle) -> RayMarcher:
        """Begin to render rays; by default all samples come in one chunk."""
        return _OneChunk(self, rays)


class _OneChunk(RayMarcher):
    def __init__(self, sampler: RaggedSampler, rays: RayBundle):
        self.sampler, self.rays = sampler, rays

    def advance(self, alive: Int[Tensor, "alive"], limit: int) -> tuple[RaggedSamples, Bool[Tensor, "alive"]]:
        """Return all samples of these rays."""
        return self.sampler(self.rays[alive], None), torch.zeros_like(alive, dtype=torch.bool)

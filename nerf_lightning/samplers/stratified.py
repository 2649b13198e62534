"""Stratified samples between near and far (Eq. 2, arXiv 2003.08934)."""

import torch

from nerf_lightning.randomness import RayRandom
from nerf_lightning.samplers.base import Sampler
from nerf_lightning.types import DenseRendering, RayBundle, RaySamples


class StratifiedSampler(Sampler):
    """Cut each ray into equal intervals, and jitter every inner fencepost of every ray within half an interval.

    Each fencepost is uniform in a stratum of its own, so the midpoints at which the field is asked cover the whole
    ray over the steps. Without random numbers the intervals are equal.

    Args:
        num_samples: intervals per ray.
    """

    def __init__(self, num_samples: int = 64):
        super().__init__()
        if num_samples < 1:
            raise ValueError(f"num_samples={num_samples}: at least one sample is needed")
        self.num_samples = num_samples

    def forward(self, rays: RayBundle, history: list[DenseRendering], random: RayRandom | None) -> RaySamples:
        """Return `num_samples` intervals from near to far."""
        s = torch.linspace(0.0, 1.0, self.num_samples + 1, device=rays.near.device)
        s = s.expand(*rays.near.shape, -1)
        if random is not None:
            jitter = random.uniform("stratified", self.num_samples - 1) - 0.5
            s = torch.cat([s[..., :1], s[..., 1:-1] + jitter / self.num_samples, s[..., -1:]], dim=-1)
        return RaySamples(edges=rays.near[..., None] + s * (rays.far - rays.near)[..., None])

    def num_samples_after(self, before: int) -> int:
        """Always `num_samples`."""
        return self.num_samples

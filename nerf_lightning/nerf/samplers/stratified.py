"""Stratified samples between near and far (Eq. 2, arXiv 2003.08934)."""

import torch

from nerf_lightning.nerf.geometry.contraction import Contracted, from_normalized_distance, normalized_distance
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.samplers.base import DenseSampler
from nerf_lightning.nerf.types.rays import RayBundle, RaySamples
from nerf_lightning.nerf.types.renderings import DenseRendering
from nerf_lightning.nerf.types.scene import Scene


class StratifiedSampler(DenseSampler):
    """Cut each ray into equal intervals, and jitter every inner fencepost of every ray within half an interval.

    Each fencepost is uniform in a stratum of its own, so the midpoints at which the field is asked cover the whole
    ray over the steps. Without random numbers the intervals are equal. In contracted scenes they are equal in the
    spacing of `geometry.spacing`, elsewhere in distance.

    Args:
        num_samples: intervals per ray.
    """

    def __init__(self, num_samples: int = 64):
        super().__init__()
        if num_samples < 1:
            raise ValueError(f"num_samples={num_samples}: at least one sample is needed")
        self.num_samples = num_samples
        self.contracted = Contracted()

    def fit_to(self, scene: Scene) -> None:
        """Take note of the scene's space."""
        self.contracted.fit_to(scene)

    def forward(self, rays: RayBundle, history: list[DenseRendering], random: RayRandom | None) -> RaySamples:
        """Return `num_samples` intervals from near to far."""
        s = torch.linspace(0.0, 1.0, self.num_samples + 1, device=rays.near.device)
        s = s.expand(*rays.near.shape, -1)
        if random is not None:
            jitter = random.uniform("stratified", self.num_samples - 1) - 0.5
            s = torch.cat([s[..., :1], s[..., 1:-1] + jitter / self.num_samples, s[..., -1:]], dim=-1)
        near, far = rays.near[..., None], rays.far[..., None]
        if self.contracted.is_on():
            low, high = normalized_distance(near), normalized_distance(far)
            return RaySamples(edges=from_normalized_distance(low + s * (high - low)), contracted_spacing=True)
        return RaySamples(edges=near + s * (far - near))

    def num_samples_after(self, before: int) -> int:
        """Always `num_samples`."""
        return self.num_samples

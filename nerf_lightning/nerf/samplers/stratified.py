"""Stratified samples between near and far (Eq. 2, arXiv 2003.08934).

How many: `conf/sampler/stratified.yaml` and its variants. Near and far: `data/captures/frame_and_extent.py`.
`kernels/histograms/cpu.py` and `cuda.py` compute the same.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.contraction import Contracted, from_normalized_distance, normalized_distance
from nerf_lightning.nerf.kernels.backends import with_kernel
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.samplers.base import DenseSampler
from nerf_lightning.nerf.types.rays import RayBundle, RaySamples
from nerf_lightning.nerf.types.renderings import DenseRendering
from nerf_lightning.nerf.types.scene import Scene


class StratifiedSampler(DenseSampler):
    """Cut each ray into equal intervals, and jitter every inner fencepost by up to half an interval.

    Each fencepost is uniform in its own stratum, so the midpoints at which the field is evaluated cover the whole ray
    over the steps. Without random numbers the intervals are equal. In contracted scenes they are equal in normalized
    distance (`geometry.contraction`), elsewhere in distance.

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
        """Record the scene's space."""
        self.contracted.fit_to(scene)

    def forward(self, rays: RayBundle, history: list[DenseRendering], random: RayRandom | None) -> RaySamples:
        """Return `num_samples` intervals from near to far."""
        shares, jitter = torch.linspace(0.0, 1.0, self.num_samples + 1, device=rays.near.device), None
        if random is not None:
            jitter = (random.uniform("stratified", self.num_samples - 1) - 0.5) / self.num_samples
        contracted, low, high = self.contracted.is_on(), rays.near, rays.far
        if contracted:
            low, high = normalized_distance(low), normalized_distance(high)
        return RaySamples(stratified_edges(shares, jitter, low, high, contracted), contracted)

    def num_samples_after(self, before: int) -> int:
        """Return `num_samples`."""
        return self.num_samples


@with_kernel("histograms.cpu", "histograms.cuda")
def stratified_edges(
    shares: Float[Tensor, "edges"],
    jitter: Float[Tensor, "*rays inner"] | None,
    low: Float[Tensor, "*rays"],
    high: Float[Tensor, "*rays"],
    contracted: bool,
) -> Float[Tensor, "*rays edges"]:
    """Return the fenceposts low + shares (high - low); contracted: the distances whose normalized distances these are.

    Args:
        shares: from 0 to 1.
        jitter: added to each ray's inner shares; None: nothing.
        low: start of each ray.
        high: end of each ray.
        contracted: whether `low` and `high` are normalized distances.
    """
    s = shares.expand(*low.shape, -1)
    if jitter is not None:
        s = torch.cat([s[..., :1], s[..., 1:-1] + jitter, s[..., -1:]], dim=-1)
    edges = low[..., None] + s * (high - low)[..., None]
    return from_normalized_distance(edges) if contracted else edges

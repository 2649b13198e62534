"""Samples drawn from what a cheaper level saw: the proposals of mip-NeRF 360 (Sec. 3, arXiv 2111.12077).

How many, and the weight added to each interval: `conf/sampler/proposal.yaml`.
"""

import torch

from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.rendering.histograms import sample_histogram
from nerf_lightning.nerf.samplers.base import DenseSampler
from nerf_lightning.nerf.types.rays import RayBundle, RaySamples
from nerf_lightning.nerf.types.renderings import DenseRendering


class ProposalSampler(DenseSampler):
    """Draw the fenceposts of this level from the histogram of the previous level, and keep none of that level's own.

    Positions carry no gradients: the previous level learns only from the interlevel loss.

    Args:
        num_samples: intervals of this level.
        padding: weight added to each interval of the previous level, so that content it misses is still sampled.
    """

    def __init__(self, num_samples: int = 24, padding: float = 0.01):
        super().__init__()
        if num_samples < 1 or padding <= 0:
            raise ValueError(f"num_samples={num_samples}, padding={padding}: both must be positive")
        self.num_samples, self.padding = num_samples, padding

    def forward(self, rays: RayBundle, history: list[DenseRendering], random: RayRandom | None) -> RaySamples:
        """Return `num_samples` intervals where the last level saw something."""
        edges, weights = history[-1].samples.edges.detach(), history[-1].weights.detach()
        count = self.num_samples + 1
        strata = torch.arange(count, device=edges.device, dtype=edges.dtype)
        within = 0.5 if random is None else random.uniform("proposal", count)
        u = ((strata + within) / count).expand(*edges.shape[:-1], -1)
        contracted = history[-1].samples.contracted_spacing
        found = sample_histogram(edges, weights, u, self.padding, contracted)
        return RaySamples(edges=found, contracted_spacing=contracted)

    def num_samples_after(self, before: int) -> int:
        """Return `num_samples`.

        Raises:
            ValueError: there is no previous level.
        """
        if before < 1:
            raise ValueError("a proposal sampler needs a level before it, to draw from")
        return self.num_samples

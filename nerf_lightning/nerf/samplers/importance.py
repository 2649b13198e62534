"""Importance samples where the previous level saw something (Sec. 5.2, arXiv 2003.08934).

How many: `conf/sampler/importance.yaml` and its variants. What is added to the weights, so that
empty intervals draw samples: HISTOGRAM_PADDING in `kernels/histograms/op.py`.
"""

from dataclasses import replace

import torch

from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.ranges import require_ranges
from nerf_lightning.nerf.rendering.histograms import sample_histogram
from nerf_lightning.nerf.samplers.base import DenseSampler
from nerf_lightning.nerf.types.rays import RayBundle, RaySamples
from nerf_lightning.nerf.types.renderings import DenseRendering


class ImportanceSampler(DenseSampler):
    """Draw fenceposts from the weights of the previous level, and merge them with its own: the sorted union.

    The histogram is of the interior intervals (without the first and last, as in the paper's code, so that light that a
    closed ray assigns to its last interval draws no samples). Positions carry no gradients: the weights are detached.

    Args:
        num_samples: intervals added to those of the previous level.
    """

    def __init__(self, num_samples: int = 128):
        super().__init__()
        require_ranges({"num_samples": num_samples}, {"num_samples": (1, 1 << 53)})
        self.num_samples = num_samples

    def forward(self, rays: RayBundle, history: list[DenseRendering], random: RayRandom | None) -> RaySamples:
        """Return the union of the last level's fenceposts and the new ones, sorted."""
        edges = history[-1].samples.edges.detach()
        weights = history[-1].weights.detach()
        strata = torch.arange(self.num_samples, device=edges.device, dtype=edges.dtype)
        within = 0.5 if random is None else random.uniform("importance", self.num_samples)
        u = ((strata + within) / self.num_samples).expand(*edges.shape[:-1], -1)
        added = sample_histogram(edges[..., 1:-1], weights[..., 1:-1], u)
        return replace(history[-1].samples, edges=torch.cat([edges, added], dim=-1).sort(dim=-1).values)

    def num_samples_after(self, before: int) -> int:
        """Return the number of the previous level, plus `num_samples`.

        Raises:
            ValueError: the previous level has no interior interval to sample from.
        """
        if before < 3:
            raise ValueError(f"importance sampling needs at least 3 samples in the level before, not {before}")
        return before + self.num_samples

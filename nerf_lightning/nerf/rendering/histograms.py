"""Histograms along a ray: inverse transform sampling of piecewise constant densities.

Letters: `edges` are bins + 1 increasing fenceposts, `weights` the mass of each bin, `u` uniform numbers in [0, 1).

`kernels/histograms/cpu.py` and `cuda.py` compute the same; `HISTOGRAM_PADDING` is in `op.py` there.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.contraction import from_normalized_distance, normalized_distance
from nerf_lightning.nerf.kernels.backends import with_kernel
from nerf_lightning.nerf.kernels.histograms.op import HISTOGRAM_PADDING
from nerf_lightning.nerf.kernels.search import search


@with_kernel("histograms.cpu", "histograms.cuda")
def sample_histogram(
    edges: Float[Tensor, "*rays edges"],
    weights: Float[Tensor, "*rays bins"],
    u: Float[Tensor, "*rays count"],
    padding: float = HISTOGRAM_PADDING,
    contracted: bool = False,
) -> Float[Tensor, "*rays count"]:
    """Return where the cumulative distribution of a histogram reaches `u` (Sec. 5.2, arXiv 2003.08934).

    Args:
        edges: fenceposts; exactly one more than there are weights.
        weights: mass of each bin; need not sum to one.
        u: sorted numbers in [0, 1).
        padding: mass added to each bin, so that an empty ray is sampled evenly and no bin has zero width in the
            distribution.
        contracted: whether the mass of a bin is uniform in `normalized_distance` instead of in distance.

    >>> sample_histogram(torch.tensor([0.0, 1, 2]), torch.tensor([0.0, 1]), torch.tensor([0.5]), padding=0.0)
    tensor([1.5000])
    """
    if edges.shape[-1] != weights.shape[-1] + 1:
        raise ValueError(f"{weights.shape[-1]} weights need {weights.shape[-1] + 1} edges, not {edges.shape[-1]}")
    if contracted:
        return from_normalized_distance(sample_histogram(normalized_distance(edges), weights, u, padding))
    mass = weights + padding
    cdf = torch.cumsum(mass / mass.sum(dim=-1, keepdim=True), dim=-1)
    cdf = torch.cat([torch.zeros_like(cdf[..., :1]), cdf], dim=-1)
    bin_index = (search(cdf, u, right=True) - 1).clamp(0, weights.shape[-1] - 1)
    below, above = cdf.gather(-1, bin_index), cdf.gather(-1, bin_index + 1)
    left, right = edges.gather(-1, bin_index), edges.gather(-1, bin_index + 1)
    span = above - below
    part = torch.where(span > 0, (u - below) / torch.where(span > 0, span, 1.0), 0.5)
    return left + part.clamp(0.0, 1.0) * (right - left)

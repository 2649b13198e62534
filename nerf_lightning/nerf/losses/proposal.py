"""The losses of mip-NeRF 360 (arXiv 2111.12077): color, proposals that bound the truth, and compact weights.

Letters: edges t, weights w of the last level; edges u, weights v of a proposal.

The weights of the terms: `conf/loss/proposal.yaml`.
`kernels/histograms/cpu.py` and `cuda.py` repeat the last two.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.contraction import normalized_distance
from nerf_lightning.nerf.kernels.backends import with_kernel
from nerf_lightning.nerf.kernels.search import search
from nerf_lightning.nerf.losses.base import Loss
from nerf_lightning.nerf.losses.mse import squared_errors
from nerf_lightning.nerf.types.rays import Target
from nerf_lightning.nerf.types.renderings import DenseRendering


class ProposalLoss(Loss):
    """Mean squared error of the last level, the interlevel loss of each proposal, and a distortion loss.

    Eq. 13 and 15 of arXiv 2111.12077; color is compared by the squared error of arXiv 2003.08934 (Eq. 6) instead of
    the Charbonnier loss.

    Args:
        interlevel: factor on the interlevel losses; it hardly matters, because proposals learn from nothing else.
        distortion: factor on the distortion loss; larger values remove fog and floaters, and too large ones detail.
    """

    needs_weights = True

    def __init__(self, interlevel: float = 1.0, distortion: float = 1e-3):
        super().__init__()
        self.interlevel, self.distortion = interlevel, distortion

    def forward(self, renderings: list[DenseRendering], target: Target) -> dict[str, Float[Tensor, "levels"]]:
        """Return weighted means over rays: interlevel of each proposal, color and distortion of the last level."""
        last, weight = renderings[-1], target.weight
        none = torch.zeros_like(last.depth[0])
        # Rays to known distances may have no color to compare.
        known = weight if target.certainty is None else weight.maximum(target.certainty)
        bounds = [self.interlevel * (interlevel_loss(last, proposal) * known).mean() for proposal in renderings[:-1]]
        before = [none] * len(bounds)
        terms = {
            "interlevel": torch.stack([*bounds, none]),
            "color": torch.stack([*before, *squared_errors([last], target)]),
        }
        if self.distortion:
            spread = self.distortion * (distortion_loss(last) * weight).mean()
            terms["distortion"] = torch.stack([*before, spread])
        return terms


@with_kernel("histograms.cpu", "histograms.cuda")
def interlevel_loss(last: DenseRendering, proposal: DenseRendering) -> Float[Tensor, "*rays"]:
    """Return sum_i max(0, w_i - bound_i)^2 / w_i of each ray (Eq. 13).

    bound_i is the weight of all intervals of the proposal that touch interval i (Eq. 12): a proposal may claim too
    much, but must cover what the last level sees. Only the proposal receives gradients.
    """
    weights, edges = last.weights.detach(), last.samples.edges.detach()
    bound = outer_weights(edges, proposal.samples.edges.detach(), proposal.weights)
    excess = (weights - bound).clamp(min=0.0)
    return (excess.square() / (weights + 1e-7)).sum(dim=-1)


def outer_weights(
    t: Float[Tensor, "*rays inner"], u: Float[Tensor, "*rays outer"], v: Float[Tensor, "*rays bins"]
) -> Float[Tensor, "*rays intervals"]:
    """Return, for each interval between neighbors of t, the weight of all intervals of u that it touches.

    >>> outer_weights(torch.tensor([0.5, 1.5, 1.75]), torch.tensor([0.0, 1, 2, 3]), torch.tensor([0.1, 0.2, 0.4]))
    tensor([0.3000, 0.2000])
    """
    total = torch.cat([torch.zeros_like(v[..., :1]), v.cumsum(dim=-1)], dim=-1)
    bins = v.shape[-1]
    first = search(u, t[..., :-1], right=True) - 1
    last = search(u, t[..., 1:])
    return total.gather(-1, last.clamp(0, bins)) - total.gather(-1, first.clamp(0, bins))


@with_kernel("histograms.cpu", "histograms.cuda")
def distortion_loss(rendering: DenseRendering) -> Float[Tensor, "*rays"]:
    """Return sum_ij w_i w_j |m_i - m_j| + sum_i w_i^2 d_i / 3 of each ray (Eq. 15).

    m and d are midpoints and lengths as shares of the sampled part of the ray, in the spacing of its samples. The
    double sum takes linear time, since the midpoints are sorted:
    2 sum_i w_i (m_i sum_{j<i} w_j - sum_{j<i} w_j m_j).
    """
    edges, w = rendering.samples.edges, rendering.weights
    if rendering.samples.contracted_spacing:
        edges = normalized_distance(edges)
    span = (edges[..., -1:] - edges[..., :1]).clamp(min=1e-6)
    m = (0.5 * (edges[..., :-1] + edges[..., 1:]) - edges[..., :1]) / span
    before, moment = w.cumsum(dim=-1) - w, (w * m).cumsum(dim=-1) - w * m
    pairs = 2.0 * (w * (m * before - moment)).sum(dim=-1)
    own = (w.square() * edges.diff(dim=-1) / span).sum(dim=-1) / 3.0
    return pairs + own

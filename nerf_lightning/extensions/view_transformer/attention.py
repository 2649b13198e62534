"""The two attentions of a view transformer: over the views of a point, and over the points of a ray.

GNT (arXiv 2207.13298). Letters: q the state of a point, x its appearance in a view, p that view's direction to it.
"""

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from nerf_lightning.nerf.matmul_precision import Linear, disable_autocast

NARROWER = 8
"""Factor by which the hidden layer of the views' weights is narrower than the states."""


class ViewAttention(nn.Module):
    """q + W sum_v softmax_v(MLP(k_v - q + p_v)) (x_v + p_v), over the views that see the point.

    Subtraction instead of products, channel by channel (Point Transformer, arXiv 2012.09164). Keys, queries and
    positions meet only in the first layer of the MLP, so each is projected into it directly: the same functions, at a
    fraction of the arithmetic. Points that no view sees keep their state.

    Args:
        width: of the states.
    """

    def __init__(self, width: int):
        super().__init__()
        self.narrow = max(1, width // NARROWER)
        self.norm = nn.LayerNorm(width, eps=1e-6)
        self.query = Linear(width, self.narrow, bias=False)
        self.turn = nn.Sequential(nn.Linear(4, self.narrow), nn.ReLU(inplace=True))
        # Key and value in one matrix product.
        self.of_view, self.of_turn = Linear(width, self.narrow + width), Linear(self.narrow, self.narrow + width)
        self.weigh, self.out = Linear(self.narrow, width), Linear(width, width)

    def forward(
        self,
        states: Float[Tensor, "rays samples width"],
        views: Float[Tensor, "rays samples sources width"],
        turned: Float[Tensor, "rays samples sources 4"],
        visible: Bool[Tensor, "rays samples sources"],
    ) -> Float[Tensor, "rays samples width"]:
        """Return the states after attention to the views."""
        known = (self.of_view(views) + self.of_turn(self.turn(turned))).float()
        key, value = known.split([self.narrow, known.shape[-1] - self.narrow], dim=-1)
        query = self.query(self.norm(states))[..., None, :]
        scores = self.weigh(functional.relu(key - query))
        seen = attend(scores.float(), value, visible)
        return states + self.out(seen) * visible.any(dim=-1)[..., None]


def attend(
    scores: Float[Tensor, "*points sources width"],
    values: Float[Tensor, "*points sources width"],
    visible: Bool[Tensor, "*points sources"],
) -> Float[Tensor, "*points width"]:
    """Return the mean of the visible values, weighted by the channel-wise softmax of their scores; 0 if none is."""
    return _Attend.apply(scores, values, visible)


class _Attend(torch.autograd.Function):
    """With o = sum_v w_v x_v and its gradient g: dx_v = w_v g and ds_v = w_v g (x_v - o).

    The backward pass of torch's own softmax takes several times as long if the last axis is not the one that sums to 1.
    """

    @staticmethod
    def forward(ctx: Any, scores: Tensor, values: Tensor, visible: Tensor) -> Tensor:
        hidden = ~visible[..., None]
        weights = scores.masked_fill(hidden, -torch.inf)
        largest = weights.amax(dim=-2, keepdim=True).clamp(min=torch.finfo(weights.dtype).min)
        weights = weights.sub_(largest).exp_()
        weights /= weights.sum(dim=-2, keepdim=True).clamp(min=torch.finfo(weights.dtype).tiny)
        seen = (weights * values).sum(dim=-2)
        ctx.save_for_backward(weights, values, seen)
        return seen

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        weights, values, seen = ctx.saved_tensors
        of_values = weights * gradient[..., None, :]
        return (values - seen[..., None, :]).mul_(of_values), of_values, None


class RayAttention(nn.Module):
    """Ordinary self-attention of the points along a ray (arXiv 1706.03762).

    Args:
        width: of the states.
        heads: number of heads.
    """

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width, eps=1e-6)
        self.query_key_value, self.out = Linear(width, 3 * width, bias=False), Linear(width, width)

    @disable_autocast
    def forward(
        self, states: Float[Tensor, "rays samples width"], with_weights: bool
    ) -> tuple[Float[Tensor, "rays samples width"], Float[Tensor, "rays samples"] | None]:
        """Return the states after self-attention, and, if `with_weights`, each one's share of all attention."""
        rays, samples, width = states.shape
        split = self.query_key_value(self.norm(states)).float().view(rays, samples, 3, self.heads, -1)
        query, key, value = split.permute(2, 0, 3, 1, 4)
        seen = functional.scaled_dot_product_attention(query, key, value)
        weights = None
        if with_weights:
            with torch.no_grad():
                scores = (query @ key.mT) * (width // self.heads) ** -0.5
                weights = scores.softmax(dim=-1).mean(dim=(1, 2))
        return states + self.out(seen.transpose(1, 2).reshape(rays, samples, width)), weights


class FeedForward(nn.Module):
    """Two layers with four times the width between them, with a residual connection.

    Args:
        width: of the states.
    """

    def __init__(self, width: int):
        super().__init__()
        self.norm = nn.LayerNorm(width, eps=1e-6)
        self.wide, self.out = Linear(width, 4 * width), Linear(4 * width, width)

    def forward(self, states: Float[Tensor, "*points width"]) -> Float[Tensor, "*points width"]:
        """Return the states after the layers."""
        return states + self.change(self.norm(states))

    def change(self, normed: Float[Tensor, "*points width"]) -> Float[Tensor, "*points width"]:
        """Return what is added to the states, given the normalized states."""
        return self.out(functional.relu(self.wide(normed)))

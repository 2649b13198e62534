"""Features of the sources at the points of rays."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from nerf_lightning.extensions.view_transformer.attention import NARROWER
from nerf_lightning.nerf.matmul_precision import Linear, disable_autocast
from nerf_lightning.nerf.types.tensor_struct import TensorStruct


@dataclass(frozen=True)
class Views(TensorStruct):
    """Features of the sources at the points of rays."""

    states: Float[Tensor, "rays samples sources width"]
    """Color and features together."""
    colors: Float[Tensor, "rays samples sources 3"]
    """In [0, 1]."""
    turned: Float[Tensor, "rays samples sources 4"]
    """The direction of the ray to the point relative to the source's (`projection.Projected`)."""
    visible: Bool[Tensor, "rays samples sources"]


class Largest(nn.Module):
    """The maximum over the views in each channel, as published (arXiv 2207.13298); 0 if no view sees the point.

    Args:
        width: of the states.
    """

    def __init__(self, width: int):
        super().__init__()

    def forward(self, views: Views) -> Float[Tensor, "rays samples width"]:
        """Return the states."""
        largest = views.states.float().masked_fill(~views.visible[..., None], -torch.inf).amax(dim=-2)
        return torch.where(views.visible.any(dim=-1)[..., None], largest, 0.0)


class Spread(Largest):
    """`Largest`, plus a linear layer on the mean and deviation of the views' colors and the variance of their states.

    Like the initial state in IBRNet (arXiv 2102.13090): if views differ, they do not see the same thing.

    Args:
        width: of the states.
    """

    def __init__(self, width: int):
        super().__init__(width)
        self.of_colors, self.of_states = nn.Linear(6, width), nn.Linear(width, width)

    @disable_autocast
    def forward(self, views: Views) -> Float[Tensor, "rays samples width"]:
        """Return the states."""
        share = views.visible / views.visible.sum(dim=-1, keepdim=True).clamp(min=1)
        mean, variance = moments(views.colors, share)
        spread = (variance + 1e-6).sqrt()
        _, of_states = moments(views.states.float(), share)
        return super().forward(views) + self.of_colors(torch.cat([mean, spread], dim=-1)) + self.of_states(of_states)


def moments(
    values: Float[Tensor, "*points sources channels"], share: Float[Tensor, "*points sources"]
) -> tuple[Float[Tensor, "*points channels"], Float[Tensor, "*points channels"]]:
    """Return the mean of values over the sources, and their variance; 0 where the shares are 0."""
    share = share[..., None]
    mean = (share * values).sum(dim=-2)
    return mean, (share * (values - mean[..., None, :]).square()).sum(dim=-2)


class PooledColor(nn.Module):
    """A linear layer on the mean of the normalized states, as published (arXiv 2207.13298).

    Args:
        width: of the states.
    """

    def __init__(self, width: int):
        super().__init__()
        self.norm, self.color = nn.LayerNorm(width), nn.Linear(width, 3)

    @disable_autocast
    def forward(
        self, states: Float[Tensor, "rays samples width"], views: Views, weights: Float[Tensor, "rays samples"]
    ) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays samples"]]:
        """Return colors, and the given weights of samples, which are those of the last attention."""
        return self.color(self.norm(states.float()).mean(dim=1)), weights


class BlendedColor(nn.Module):
    """sum_s a_s sum_v b_sv c_sv of the sources' own colors, plus a correction from the pooled state.

    a is a softmax along the ray, over the points that any source sees, and b one over the sources of a point, as in
    IBRNet (arXiv 2102.13090). It begins as the mean of all colors of a ray's points in the sources, and must learn
    where they agree, but not what colors are.

    Args:
        width: of the states.
    """

    def __init__(self, width: int):
        super().__init__()
        narrow = max(1, width // NARROWER)
        self.norm, self.color, self.where = nn.LayerNorm(width), nn.Linear(width, 3), nn.Linear(width, 1)
        self.of_view, self.of_state = Linear(width, narrow), Linear(width, narrow, bias=False)
        self.of_turn = nn.Linear(4, narrow, bias=False)
        self.which = nn.Linear(narrow, 1)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Begin with a correction of 0."""
        nn.init.zeros_(self.color.weight)
        nn.init.zeros_(self.color.bias)

    @disable_autocast
    def forward(
        self, states: Float[Tensor, "rays samples width"], views: Views, weights: Float[Tensor, "rays samples"]
    ) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays samples"]]:
        """Return colors, and the weights of samples in them."""
        states = self.norm(states.float())
        of_views = self.of_view(views.states) + self.of_turn(views.turned) + self.of_state(states)[..., None, :]
        which = self.which(functional.relu(of_views.float()))[..., 0].masked_fill(~views.visible, -1e9).softmax(dim=-1)
        seen = (which[..., None] * views.colors).sum(dim=-2)
        of_points = self.where(states)[..., 0].masked_fill(~views.visible.any(dim=-1), -1e9).softmax(dim=-1)
        return (of_points[..., None] * seen).sum(dim=1) + self.color(states.mean(dim=1)), of_points

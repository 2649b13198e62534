"""What the state of a point is before it has looked at anything."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerf_lightning.nerf.models.view_transformer.views import Views
from nerf_lightning.nerf.products import own_precision


class Largest(nn.Module):
    """In each channel the largest of what the views show, as published (arXiv 2207.13298); 0 where none sees it.

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
    """And a linear layer on the mean and the deviation of the views' colours, and on the variance of their states.

    As IBRNet begins (arXiv 2102.13090): where views differ, they do not see the same thing.

    Args:
        width: of the states.
    """

    def __init__(self, width: int):
        super().__init__(width)
        self.of_colors, self.of_states = nn.Linear(6, width), nn.Linear(width, width)

    @own_precision
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
    """Return the mean of values over the sources, and their variance; 0 where the shares are."""
    share = share[..., None]
    mean = (share * values).sum(dim=-2)
    return mean, (share * (values - mean[..., None, :]).square()).sum(dim=-2)

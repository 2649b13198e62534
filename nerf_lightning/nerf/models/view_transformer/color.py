"""From the states of a ray's points to its colour: read off their mean, or blended of what the sources show there."""

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nerf_lightning.nerf.models.view_transformer.attention import NARROWER
from nerf_lightning.nerf.models.view_transformer.views import Views
from nerf_lightning.nerf.products import Linear, own_precision


class PooledColor(nn.Module):
    """A linear layer on the mean of the normalised states, as published (arXiv 2207.13298).

    Args:
        width: of the states.
    """

    def __init__(self, width: int):
        super().__init__()
        self.norm, self.color = nn.LayerNorm(width), nn.Linear(width, 3)

    @own_precision
    def forward(
        self, states: Float[Tensor, "rays samples width"], views: Views, weights: Float[Tensor, "rays samples"]
    ) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays samples"]]:
        """Return colours, and the weights of samples as they were given: those of the last attention."""
        return self.color(self.norm(states.float()).mean(dim=1)), weights


class BlendedColor(nn.Module):
    """sum_s a_s sum_v b_sv c_sv, the sources' own colours, and what the pooled state adds to them.

    a is a softmax along the ray, over the points that any source sees, b one over the sources of a point, as IBRNet
    blends (arXiv 2102.13090). It begins as the mean of all colours that a ray's points have in the sources, and has to
    learn where they agree, but not what colours are.

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
        """Begin with nothing added to the sources' colours."""
        nn.init.zeros_(self.color.weight)
        nn.init.zeros_(self.color.bias)

    @own_precision
    def forward(
        self, states: Float[Tensor, "rays samples width"], views: Views, weights: Float[Tensor, "rays samples"]
    ) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays samples"]]:
        """Return colours, and the weights of samples in them."""
        states = self.norm(states.float())
        of_views = self.of_view(views.states) + self.of_turn(views.turned) + self.of_state(states)[..., None, :]
        which = self.which(functional.relu(of_views.float()))[..., 0].masked_fill(~views.visible, -1e9).softmax(dim=-1)
        seen = (which[..., None] * views.colors).sum(dim=-2)
        of_points = self.where(states)[..., 0].masked_fill(~views.visible.any(dim=-1), -1e9).softmax(dim=-1)
        return (of_points[..., None] * seen).sum(dim=1) + self.color(states.mean(dim=1)), of_points

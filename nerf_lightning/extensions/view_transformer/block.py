"""One block of a view transformer."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerf_lightning.extensions.view_transformer.attention import FeedForward, RayAttention, ViewAttention
from nerf_lightning.extensions.view_transformer.experts import Experts, Gates
from nerf_lightning.extensions.view_transformer.views import Views
from nerf_lightning.nerf.encoders.frequency import FrequencyEncoder
from nerf_lightning.nerf.matmul_precision import Linear
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.types.rays import RayBundle

FREQUENCIES = 10


class Block(nn.Module):
    """Attention over views, feed-forward layer or experts, encodings, attention along the ray, feed-forward layer.

    Args:
        width: of the states.
        heads: heads of the attention along the ray.
        encoded: whether to use the encodings of points and directions.
        experts: number of experts that replace the first feed-forward layer; 0: none.
    """

    def __init__(self, width: int, heads: int, encoded: bool, experts: int):
        super().__init__()
        self.over_views = ViewAttention(width)
        self.after_views = Experts(width, experts) if experts else FeedForward(width)
        self.encoder = FrequencyEncoder(FREQUENCIES) if encoded else None
        if self.encoder is not None:
            joined = width + 2 * self.encoder.out_dim
            self.enter = nn.Sequential(Linear(joined, width), nn.ReLU(inplace=True), Linear(width, width))
        self.along_ray = RayAttention(width, heads)
        self.after_ray = FeedForward(width)

    def forward(
        self,
        states: Float[Tensor, "rays samples width"],
        views: Views,
        positions: Float[Tensor, "rays samples 3"],
        rays: RayBundle,
        random: RayRandom | None,
        with_weights: bool,
    ) -> tuple[Float[Tensor, "rays samples width"], Gates | None, Float[Tensor, "rays samples"] | None]:
        """Return the states; the gates of the experts, if any; and the weights of samples, if `with_weights`."""
        gates = None
        states = self.over_views(states, views.states, views.turned, views.visible)
        if isinstance(self.after_views, Experts):
            states, gates = self.after_views(states, _noise(states, self.after_views.experts, random))
        else:
            states = self.after_views(states)
        if self.encoder is not None:
            direction = self.encoder(rays.view_directions)[:, None].expand(-1, states.shape[1], -1)
            states = self.enter(torch.cat([states, self.encoder(positions), direction], dim=-1))
        states, weights = self.along_ray(states, with_weights)
        return self.after_ray(states), gates, weights


def _noise(states: Tensor, experts: int, random: RayRandom | None) -> Float[Tensor, "rays samples experts"] | None:
    if random is None:
        return None
    return random.normal("experts", states.shape[1] * experts).view(*states.shape[:2], experts)

"""The gradients of a batch, tile by tile: what a tile needs stays in the cache, and the sum is the whole batch's."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.models.tiles import tiles
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.rendering.blending import background_colors, blend
from nerf_lightning.nerf.types.rays import Batch
from nerf_lightning.nerf.types.scene import Background

LossFn = Callable[..., Sequence[Float[Tensor, ""]]]


@dataclass(frozen=True)
class Share:
    """A process's part of a step's batch."""

    first: int
    """Its first ray's slot in the batch."""
    num_rays: int
    """Rays of the whole batch."""
    weight: Tensor
    """Sum of the weights of the whole batch."""


def add_gradients(
    model: RadianceModel,
    loss: LossFn,
    backward: Callable[[Tensor], None],
    batch: Batch,
    share: Share,
    random: RayRandom,
    background: Background,
    tile_rays: int,
) -> dict[str, Tensor]:
    """Send a batch forward and backward.

    Args:
        model: the levels.
        loss: of renderings, targets and weights: a number per level.
        backward: adds a loss's gradients to the parameters'.
        batch: rays, colours, weights.
        share: what part of the step's batch this is.
        random: the step's numbers for these rays.
        background: what lies behind them.
        tile_rays: most rays at once.

    Returns:
        `losses` per level, and each ray's `foreground` light, `target` colour and `weight`, detached.
    """
    num_rays = batch.rays.near.numel()
    behind = background_colors(background, num_rays, batch.rays.near.device, random)
    target = blend(batch.rgba, behind)
    # A mean of 1 over the batch, not over each tile. Without masks this is 1 exactly and changes no bit.
    weight = batch.weight * (share.num_rays / share.weight.clamp(min=1.0))
    losses, foreground = [], []
    for tile in tiles(num_rays, tile_rays):
        renderings = model(batch.rays[tile], None if behind is None else behind[tile], random[tile])
        part = torch.stack(list(loss(renderings, target[tile], weight[tile])))
        part = part * (target[tile].shape[0] / share.num_rays)
        backward(part.sum())
        losses.append(part.detach())
        foreground.append(renderings[-1].foreground.detach())
    seen = {"foreground": torch.cat(foreground), "target": target, "weight": batch.weight}
    return {"losses": torch.stack(losses).sum(0)} | seen

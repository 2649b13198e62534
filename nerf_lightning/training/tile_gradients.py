"""Gradients of a batch that goes through the model in tiles: beside each other on a CPU's cores, else in turn.

Most operations of a step are too small to be shared out one by one: two threads that take a tile each, forward and
backward, are almost twice as fast as one, where two threads in every operation gained a fifth.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import Parameter

from nerf_lightning.nerf.kernels.hash_grid.interpolate import TableGradient, add_all, defer_table_grads
from nerf_lightning.nerf.kernels.threads import in_parallel
from nerf_lightning.nerf.types.tensor_struct import TensorStruct

Backward = Callable[[Tensor], None]


@dataclass(frozen=True)
class TileLoss(TensorStruct):
    """What a tile of rays adds to the loss of its batch."""

    levels: Float[Tensor, "levels"]
    """Each level's loss."""
    terms: dict[str, Float[Tensor, "levels"]]
    """The same by term, detached."""
    errors: Float[Tensor, "levels"]
    """Each level's mean squared error of color, whatever its loss is; of one that shows none it means nothing."""
    foreground: Float[Tensor, "rays 3"]
    """The light of its rays without the background's."""
    rgb: Float[Tensor, "rays 3"]
    """What was compared with the photographs."""

    @classmethod
    def joined(cls, tiles: Sequence["TileLoss"]) -> "TileLoss":
        """Return what tiles add up to, their rays one after the other."""
        if len(tiles) == 1:
            return tiles[0]
        return cls(
            levels=torch.stack([each.levels for each in tiles]).sum(0),
            terms={name: torch.stack([each.terms[name] for each in tiles]).sum(0) for name in tiles[0].terms},
            errors=torch.stack([each.errors for each in tiles]).sum(0),
            foreground=torch.cat([each.foreground for each in tiles]),
            rgb=torch.cat([each.rgb for each in tiles]),
        )


def sequential_backward(
    lose: Callable[[slice], TileLoss], tiles: Sequence[slice], backward: Backward
) -> list[TileLoss]:
    """Send one tile after the other forward and backward, and return what they have lost, in order."""
    losses = []
    for tile in tiles:
        lost = lose(tile)
        backward(lost.levels.sum())
        losses.append(lost.map(Tensor.detach))
    return losses


def parallel_backward(
    lose: Callable[[slice], TileLoss], tiles: Sequence[slice], backward: Backward, parameters: Sequence[Parameter]
) -> list[TileLoss]:
    """Do the same on as many threads as torch has; sums are taken in the order of the tiles, so their bits are fixed.

    `backward` is called once, with the loss of all tiles, and hands on the gradients that the threads have found.
    """
    learnt = [parameter for parameter in parameters if parameter.requires_grad]

    def work(tile: slice) -> tuple[TileLoss, Sequence[Tensor | None], Sequence[TableGradient]]:
        with defer_table_grads() as held:
            lost = lose(tile)
            gradients = torch.autograd.grad(lost.levels.sum(), learnt, allow_unused=True)
        return lost.map(Tensor.detach), gradients, held

    found = in_parallel(work, tiles)
    losses = [lost for lost, _, _ in found]
    total = torch.stack([lost.levels for lost in losses]).sum()
    held = [each for _, _, of_tile in found for each in of_tile]
    sums = [_sum([gradients[number] for _, gradients, _ in found]) for number in range(len(learnt))]
    backward(_PrecomputedGradients.apply(total, sums, held, *learnt))
    return losses


def _sum(gradients: Sequence[Tensor | None]) -> Tensor | None:
    found = [gradient for gradient in gradients if gradient is not None]
    return torch.stack(found).sum(dim=0) if found else None


class _PrecomputedGradients(torch.autograd.Function):
    """A loss whose gradients are known already."""

    @staticmethod
    def forward(ctx: Any, total: Tensor, sums: list[Tensor | None], held: list[TableGradient], *_: Tensor) -> Tensor:
        ctx.sums, ctx.held = sums, held
        return total.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, scale: Tensor) -> tuple[Tensor | None, ...]:
        add_all(ctx.held, float(scale))
        return None, None, None, *(None if found is None else found * scale for found in ctx.sums)

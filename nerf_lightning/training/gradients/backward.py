"""Gradients of a batch that goes through the model in tiles: beside each other on a CPU's cores, else in turn.

Most operations of a step are too small to be shared out one by one: two threads that take a tile each, forward and
backward, are almost twice as fast as one, where two threads in every operation gained a fifth.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter

from nerf_lightning.nerf.kernels.hash_grid.op import TableGradient, add_all, defer_table_grads
from nerf_lightning.nerf.kernels.threads import in_parallel
from nerf_lightning.nerf.types.step_output import StepOutput

Backward = Callable[[Tensor], None]
"""Adds the gradients of a loss to those of the parameters."""


def sequential_backward(
    lose: Callable[[slice], StepOutput], tiles: Sequence[slice], backward: Backward
) -> list[StepOutput]:
    """Send one tile after the other forward and backward, and return what they have lost, in order."""
    losses = []
    for tile in tiles:
        lost = lose(tile)
        backward(lost.losses.sum())
        losses.append(lost.map(Tensor.detach))
    return losses


def parallel_backward(
    lose: Callable[[slice], StepOutput], tiles: Sequence[slice], backward: Backward, parameters: Sequence[Parameter]
) -> list[StepOutput]:
    """Do the same on as many threads as torch has; sums are taken in the order of the tiles, so their bits are fixed.

    `backward` is called once, with the loss of all tiles, and hands on the gradients that the threads have found.
    """
    learnt = [parameter for parameter in parameters if parameter.requires_grad]

    def work(tile: slice) -> tuple[StepOutput, Sequence[Tensor | None], Sequence[TableGradient]]:
        with defer_table_grads() as held:
            lost = lose(tile)
            gradients = torch.autograd.grad(lost.losses.sum(), learnt, allow_unused=True)
        return lost.map(Tensor.detach), gradients, held

    found = in_parallel(work, tiles)
    losses = [lost for lost, _, _ in found]
    total = torch.stack([lost.losses for lost in losses]).sum()
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

"""A number per ray whose gradient for some weights is found with it: one pass over each ray."""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor


class RayLoss(torch.autograd.Function):
    """Apply it to what computes, the weights that have a gradient, and whatever else the number depends on."""

    @staticmethod
    def forward(ctx: Any, compute: Callable[..., None], weights: Tensor, *given: Tensor) -> Float[Tensor, "rays"]:
        """Call `compute(weights, *given, out, grad)`, which writes the last two."""
        arrays = [each.detach().contiguous() for each in (weights, *given)]
        out, grad = weights.new_empty(len(weights)), torch.empty_like(arrays[0])
        if out.numel():
            compute(*arrays, out, grad)
        ctx.save_for_backward(grad)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradient of the weights."""
        (own,) = ctx.saved_tensors
        return None, own * grad[:, None], *[None] * (len(ctx.needs_input_grad) - 2)

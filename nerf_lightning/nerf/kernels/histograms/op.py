"""What histogram kernels accept on every device, and losses whose gradient is computed along with their value."""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.types.renderings import DenseRendering

HISTOGRAM_PADDING = 1e-5
"""Mass added to each bin of a histogram, unless its sampler says otherwise: an empty ray is sampled evenly."""


class RayLoss(torch.autograd.Function):
    """Apply it to the function that computes, the weights that have a gradient, and the loss's other inputs."""

    @staticmethod
    def forward(ctx: Any, compute: Callable[..., None], weights: Tensor, *inputs: Tensor) -> Float[Tensor, "rays"]:
        """Call `compute(weights, *inputs, out, grad)`, which writes the last two."""
        arrays = [each.detach().contiguous() for each in (weights, *inputs)]
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


def takes_histogram(edges: Tensor, weights: Tensor, u: Tensor) -> bool:
    """Return whether kernels can sample a histogram: without gradients, for contiguous float32 rays."""
    plain = _are_rows(edges, weights, u) and edges.shape[1] == weights.shape[1] + 1
    return plain and not (edges.requires_grad or weights.requires_grad)


def takes_bounds(low: Tensor, high: Tensor) -> bool:
    """Return whether kernels can divide the range between bounds: without gradients, for contiguous float32 rays."""
    plain = low.dim() == 1 and low.dtype == torch.float32
    return plain and not (low.requires_grad or high.requires_grad)


def interlevel(
    compute: Callable[..., None], last: DenseRendering, proposal: DenseRendering
) -> Float[Tensor, "rays"] | None:
    """Return a kernel's interlevel loss, with gradients for the proposal's weights; None if rays are not contiguous."""
    if not _are_rows(last.weights, proposal.weights):
        return None
    given = last.samples.edges, last.weights, proposal.samples.edges
    return RayLoss.apply(compute, proposal.weights, *map(Tensor.detach, given))


def distortion(compute: Callable[..., None], rendering: DenseRendering) -> Float[Tensor, "rays"] | None:
    """Return a kernel's distortion loss, with gradients for the weights; None if the edges need gradients, too."""
    edges, weights = rendering.samples.edges, rendering.weights
    return RayLoss.apply(compute, weights, edges) if _are_rows(weights) and not edges.requires_grad else None


def _are_rows(*tensors: Tensor) -> bool:
    return all(each.dim() == 2 and each.dtype == torch.float32 for each in tensors)

"""The MLP for the CPU by torch's products: tiles of rows, on our own threads instead of torch's, as many as torch has.

The tiles and the order of their sums are fixed, so the result does not depend on the number of threads.
"""

import functools
from collections.abc import Sequence

import torch
from torch import Tensor

from nerf_lightning.nerf.kernels.threads import in_parallel
from nerf_lightning.nerf.matmul_precision import TILE_ROWS, disable_autocast, multiply, pad_rows, tiles_of_rows

relu_backward_ = functools.partial(torch.ops.aten.threshold_backward.grad_input, threshold=0)


@disable_autocast
def forward(points: Tensor, weights: Sequence[Tensor], keep: bool) -> tuple[Tensor, list[list[Tensor]]]:
    """Return the outputs in float32, and each tile's inputs of every layer if they are kept."""
    out = points.new_empty(points.shape[0], weights[-1].shape[0])

    def tile(rows: slice) -> list[Tensor]:
        hidden = pad_rows(points[rows], weights[0].dtype)
        kept = [hidden]
        for weight in weights[:-1]:
            hidden = multiply(hidden, weight.t()).relu_()
            if keep:
                kept.append(hidden)
        out[rows] = multiply(hidden, weights[-1].t())[: rows.stop - rows.start]
        return kept if keep else []

    return out, in_parallel(tile, tiles_of_rows(points.shape[0]))


@disable_autocast
def backward(
    grad: Tensor, weights: Sequence[Tensor], activations: list[list[Tensor]], wants_points: bool
) -> tuple[Tensor | None, list[Tensor]]:
    """Return the gradients of the inputs and, in float32, of the weights; `activations` is what `forward` kept."""
    grad_points = grad.new_empty(grad.shape[0], weights[0].shape[1]) if wants_points else None

    def tile(rows: slice) -> list[Tensor]:
        kept = activations[rows.start // TILE_ROWS]
        flowing = pad_rows(grad[rows], weights[0].dtype)
        grads: list[Tensor] = []
        for layer in reversed(range(len(weights))):
            grads.insert(0, multiply(flowing.t(), kept[layer]))
            if layer == 0 and grad_points is None:
                break
            flowing = multiply(flowing, weights[layer])
            if layer:
                relu_backward_(flowing, kept[layer], grad_input=flowing)
            elif grad_points is not None:
                grad_points[rows] = flowing[: rows.stop - rows.start]
        return grads

    parts = in_parallel(tile, tiles_of_rows(grad.shape[0]))
    if not parts:
        return grad_points, [torch.zeros_like(weight, dtype=torch.float32) for weight in weights]
    return grad_points, [torch.stack([part[layer].float() for part in parts]).sum(0) for layer in range(len(weights))]

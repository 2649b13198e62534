"""Small multilayer perceptrons without biases: matrix products with ReLU between them.

At widths of 64, a general framework spends as much time moving activations through memory as on arithmetic. On the CPU
each core takes tiles of rows through all layers, forward and backward, so that they stay in its cache; on CUDA a block
of rows stays in registers.
"""

from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import cpu_backend, cuda_backend, is_on
from nerf_lightning.nerf.kernels.mlp import cpu_torch
from nerf_lightning.nerf.matmul_precision import MatmulPrecision, linear


def mlp(
    points: Float[Tensor, "points in"],
    weights: list[Tensor],
    matmul_precision: MatmulPrecision = "float32",
    used: Int[Tensor, "1"] | None = None,
) -> Float[Tensor, "points out"]:
    """Return W_n relu(... relu(W_1 x)); each weight has shape (out, in). Gradients of weights are float32.

    Args:
        points: the inputs.
        weights: weight of each layer.
        matmul_precision: precision of the products.
        used: on CUDA, the index from which all rows are padding: kernels skip it, and it has no gradients.
    """
    found = _kernels_for(points, weights, matmul_precision)
    if found is None:
        return mlp_torch(points, weights, matmul_precision)
    kernels, dtype = found
    padding = (used,) if used is not None and points.is_cuda else ()
    if torch.is_grad_enabled() and any(x.requires_grad for x in (points, *weights)):
        return _TiledMLP.apply(points, kernels, dtype, padding, *weights)
    return kernels.forward(points.detach(), [weight.detach().to(dtype) for weight in weights], False, *padding)[0]


def mlp_torch(
    points: Float[Tensor, "points in"], weights: list[Tensor], matmul_precision: MatmulPrecision = "float32"
) -> Float[Tensor, "points out"]:
    """Return the same in plain torch: the reference, and the fallback without kernels."""
    for weight in weights[:-1]:
        points = linear(points, weight, None, matmul_precision).relu_()
    return linear(points, weights[-1], None, matmul_precision)


def _kernels_for(
    points: Tensor, weights: list[Tensor], matmul_precision: MatmulPrecision
) -> tuple[ModuleType, torch.dtype] | None:
    """Return the device's kernels, and the dtype in which they take the weights."""
    if points.dtype == torch.float64:
        return None
    if points.is_cuda:
        kernels = cuda_backend("mlp.cuda", points.device) if matmul_precision == "bfloat16" else None
        sizes = (weights[0].shape[1], *(weight.shape[0] for weight in weights))
        takes = kernels is not None and kernels.takes(sizes, points.device)
        return (kernels, torch.float32) if kernels is not None and takes else None  # it rounds by itself
    if not points.is_cpu or not is_on("mlp.cpu"):
        return None
    kernels, dtype = (
        cpu_backend("mlp.cpu", points.device),
        torch.bfloat16 if matmul_precision == "bfloat16" else points.dtype,
    )
    return (kernels if kernels is not None and kernels.takes(weights, dtype) else cpu_torch), dtype


class _TiledMLP(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, points: Tensor, kernels: ModuleType, dtype: torch.dtype, padding: tuple[Tensor, ...], *weights: Tensor
    ) -> Tensor:
        rounded = [weight.detach().to(dtype) for weight in weights]
        out, activations = kernels.forward(points.detach(), rounded, True, *padding)
        ctx.kernels, ctx.rounded, ctx.activations, ctx.padding = kernels, rounded, activations, padding
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:
        grad_points, grad_weights = ctx.kernels.backward(
            grad.contiguous(), ctx.rounded, ctx.activations, ctx.needs_input_grad[0], *ctx.padding
        )
        ctx.activations = None
        return grad_points, None, None, None, *grad_weights

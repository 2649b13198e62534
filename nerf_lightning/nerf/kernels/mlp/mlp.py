"""Small multilayer perceptrons without biases: matrix products with ReLU between them.

At widths of 64 a general framework spends as much on moving activations through memory as on arithmetic. On the CPU
each core takes tiles of rows through all layers, forward and backward, so that they stay in its cache.
"""

from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import is_on, twin
from nerf_lightning.nerf.kernels.mlp import cpu as mlp_cpu
from nerf_lightning.nerf.products import Products, cpu_multiplies_bfloat16, linear


def mlp(
    points: Float[Tensor, "points in"], weights: list[Tensor], products: Products = "float32"
) -> Float[Tensor, "points out"]:
    """Return W_n relu(... relu(W_1 x)); each weight has shape (out, in). Gradients of weights are float32."""
    if points.device.type != "cpu" or points.dtype == torch.float64 or not is_on("mlp.cpu"):
        return mlp_torch(points, weights, products)
    kernels = _in_bfloat16(weights) if products == "bfloat16" else None
    if kernels is not None:
        if torch.is_grad_enabled() and any(x.requires_grad for x in (points, *weights)):
            return _FusedMLP.apply(points, kernels, *weights)
        return kernels.forward(points.detach().float(), [weight.detach().float() for weight in weights], keep=False)[0]
    dtype = torch.bfloat16 if products == "bfloat16" else points.dtype
    if torch.is_grad_enabled() and any(x.requires_grad for x in (points, *weights)):
        return _TiledMLP.apply(points, dtype, *weights)
    return mlp_cpu.forward(points, [weight.to(dtype) for weight in weights], keep=False)[0]


def mlp_torch(
    points: Float[Tensor, "points in"], weights: list[Tensor], products: Products = "float32"
) -> Float[Tensor, "points out"]:
    """Return the same in plain torch: the reference, and what runs on GPUs."""
    for weight in weights[:-1]:
        points = linear(points, weight, None, products).relu_()
    return linear(points, weights[-1], None, products)


def _in_bfloat16(weights: list[Tensor]) -> ModuleType | None:
    """Return the kernels for the CPU's own bfloat16, where it has it and they take such a perceptron."""
    if not cpu_multiplies_bfloat16() or not is_on("mlp.bfloat16"):
        return None
    kernels = twin("mlp.bfloat16")
    return kernels if kernels is not None and kernels.takes([weight.shape[1] for weight in weights]) else None


class _FusedMLP(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, kernels: ModuleType, *weights: Tensor) -> Tensor:
        used = [weight.detach().float() for weight in weights]
        out, ctx.kept = kernels.forward(points.detach().float(), used, keep=True)
        ctx.used, ctx.kernels = used, kernels
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:
        of_points, of_weights = ctx.kernels.backward(
            grad.float().contiguous(), ctx.used, ctx.kept, ctx.needs_input_grad[0]
        )
        ctx.kept = None
        return of_points, None, *of_weights


class _TiledMLP(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, dtype: torch.dtype, *weights: Tensor) -> Tensor:
        used = [weight.detach().to(dtype) for weight in weights]
        out, activations = mlp_cpu.forward(points.detach(), used, keep=True)
        ctx.used, ctx.activations = used, activations
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:
        grad_points, grad_weights = mlp_cpu.backward(
            grad.contiguous(), ctx.used, ctx.activations, ctx.needs_input_grad[0]
        )
        ctx.activations = None
        return grad_points, None, *grad_weights

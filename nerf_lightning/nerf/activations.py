"""From a network's raw outputs to density and color.

Kernels compute the same, with these constants: `kernels/render/cpu.py`, `compositing.py` and `cuda.py`, and
`kernels/field/cuda.py`.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

LARGEST_RAW = 30.0
"""Raw densities are clamped to this before exp."""
LARGEST_SLOPE_RAW = 15.0
"""Beyond it the slope of the density stops growing (or, below its negative, falling)."""
LEAST_SLOPE = 0.003
"""Minimum slope of a color over its raw value, on the way back from black or full: the slope at a color of 0.003 or
0.997. With alpha, which teaches the density what is empty, it is not needed, and costs 0.08 dB on Lego."""


def density_from(raw: Float[Tensor, "*points"]) -> Float[Tensor, "*points"]:
    """Return exp(raw), whose gradient stops growing at exp(15): one wild sample must not end the run."""
    return _TruncatedExponential.apply(raw)


def color_from(raw: Float[Tensor, "*points 3"], least_slope: float) -> Float[Tensor, "*points 3"]:
    """Return 1 / (1 + exp(-raw)), with a slope of at least `least_slope` on the way back from black or full."""
    return _Sigmoid.apply(raw, least_slope) if least_slope else torch.sigmoid(raw)


class _TruncatedExponential(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, raw: Tensor) -> Tensor:
        ctx.save_for_backward(raw)
        return torch.exp(raw.clamp(max=LARGEST_RAW))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (raw,) = ctx.saved_tensors
        return grad * torch.exp(raw.clamp(-LARGEST_SLOPE_RAW, LARGEST_SLOPE_RAW))


class _Sigmoid(torch.autograd.Function):
    """1 / (1 + exp(-x)), with a way back from black and full colors, where its slope vanishes.

    If nearly all pixels are black, all colors fall to 1e-38 within ten steps, and the gradients of the few pixels with
    content would be multiplied by as little. Steps farther out keep the true slope: with the same minimum, they would
    carry the weights away without end, at a cost of 6 dB on photographs with dark corners.
    """

    @staticmethod
    def forward(ctx: Any, raw: Tensor, least_slope: float) -> Tensor:
        color = torch.sigmoid(raw)
        ctx.save_for_backward(color)
        ctx.least_slope = least_slope
        return color

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        (color,) = ctx.saved_tensors
        slope = color * (1.0 - color)
        inward = grad * (color - 0.5) > 0  # a step goes against the gradient
        return grad * torch.where(inward, slope.clamp(min=ctx.least_slope), slope), None

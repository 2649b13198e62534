"""Adam's step for CUDA, in one pass over memory. `TRITON_INTERPRET=1` runs the kernel without a GPU."""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor

BLOCK = 1024


def adam_step(
    parameter: Tensor,
    grad: Tensor,
    first: Tensor,
    second: Tensor,
    step_size: float,
    root_scale: float,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """Update contiguous float32 arrays in place."""
    count = parameter.numel()
    if count:
        numbers = step_size, root_scale, *betas, eps
        _update[(triton.cdiv(count, BLOCK),)](parameter, grad, first, second, *numbers, count, BLOCK)


def trial(device: str = "cuda") -> None:
    """Run the kernel once on next to nothing; it raises whatever its compiler or driver raises.

    Raises:
        RuntimeError: it computes wrongly.
    """
    parameter, grad, first, second = torch.tensor([[1.0, 1.0], [2.0, 0.0], [0.0, 3.0], [0.0, 4.0]], device=device)
    adam_step(parameter, grad, first, second, 0.5, 1.0, (0.0, 0.0), 1e-15)
    if parameter.tolist() != [0.5, 1.0] or grad.any() or second.tolist() != [4.0, 4.0]:
        raise RuntimeError("a trial of its kernels gave wrong numbers")


@triton.jit
@no_type_check
def _update(parameter, grad, first, second, step_size, root_scale, beta1, beta2, eps, count, block: tl.constexpr):
    index = (tl.program_id(0) * block + tl.arange(0, block)).to(tl.int64)
    valid = index < count
    g = tl.load(grad + index, mask=valid, other=0.0)
    touched = g != 0.0  # others are neither read nor written; NaN is not zero
    p = tl.load(parameter + index, mask=touched, other=0.0)
    m = tl.load(first + index, mask=touched, other=0.0)
    v = tl.load(second + index, mask=touched, other=0.0)
    m = beta1 * m + (1.0 - beta1) * g
    v = beta2 * v + (1.0 - beta2) * g * g
    p -= step_size * m / (root_scale * tl.sqrt(v) + eps)
    tl.store(parameter + index, p, mask=touched)
    tl.store(first + index, m, mask=touched)
    tl.store(second + index, v, mask=touched)
    tl.store(grad + index, 0.0, mask=touched)

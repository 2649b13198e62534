"""Adam's step for CUDA: all parameters in one launch and one pass. `TRITON_INTERPRET=1` runs it without a GPU."""

import functools
from collections.abc import Sequence
from typing import no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor

BLOCK = 1024


def adam_steps(
    parameters: Sequence[Sequence[Tensor]],
    step_size: float,
    root_scale: float,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """Update parameters in place, each with its gradient and moments: contiguous, in float32, on one device."""
    pointers = tuple(tuple(x.data_ptr() for x in row) for row in parameters)
    table, owners = _table(pointers, tuple(row[0].numel() for row in parameters), parameters[0][0].device)
    if len(owners):
        _update[(len(owners),)](table, owners, step_size, root_scale, *betas, eps, BLOCK)


@functools.lru_cache(maxsize=16)
def _table(
    pointers: tuple[tuple[int, ...], ...], counts: tuple[int, ...], device: torch.device
) -> tuple[Tensor, Tensor]:
    """Return address, first block and size of each parameter, and the parameter of each block.

    They stay on the device as long as the addresses, which the arguments contain, do not change.
    """
    blocks = [triton.cdiv(count, BLOCK) for count in counts]
    first = [sum(blocks[:number]) for number in range(len(blocks))]
    rows = [[*row, *numbers] for row, *numbers in zip(pointers, first, counts, strict=True)]
    owners = torch.arange(len(blocks)).repeat_interleave(torch.tensor(blocks))
    return torch.tensor(rows).to(device), owners.to(device)


def trial(device: str = "cuda") -> None:
    """Run the kernel once on tiny input; it raises whatever the compiler or driver raises.

    Raises:
        RuntimeError: the result is wrong.
    """
    parameter, grad, first, second = torch.tensor([[1.0, 1.0], [2.0, 0.0], [0.0, 3.0], [0.0, 4.0]], device=device)
    adam_steps([(parameter, grad, first, second)], 0.5, 1.0, (0.0, 0.0), 1e-15)
    if parameter.tolist() != [0.5, 1.0] or grad.any() or second.tolist() != [4.0, 4.0]:
        raise RuntimeError("a trial of its kernels gave wrong numbers")


@triton.jit
@no_type_check
def _update(table, owners, step_size, root_scale, beta1, beta2, eps, block: tl.constexpr):
    program = tl.program_id(0)
    row = table + 6 * tl.load(owners + program)
    parameter, grad = tl.load(row).to(tl.pointer_type(tl.float32)), tl.load(row + 1).to(tl.pointer_type(tl.float32))
    first, second = tl.load(row + 2).to(tl.pointer_type(tl.float32)), tl.load(row + 3).to(tl.pointer_type(tl.float32))
    index = (program - tl.load(row + 4)) * block + tl.arange(0, block)
    valid = index < tl.load(row + 5)
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

"""Adam's step for CUDA: all parameters in one launch and one pass. `TRITON_INTERPRET=1` runs it without a GPU."""

from collections.abc import Sequence
from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

BLOCK = 1024


def adam_steps(table: Tensor, owners: Tensor, numbers: Float[Tensor, "parameters 5"]) -> None:
    """Update parameters in place, each with its gradient and moments: contiguous, in float32, on one device.

    Args:
        table: see `address_table`, also for the owners.
        owners: the parameter of each block.
        numbers: step_size, root_scale, b1, b2 and eps of each parameter.
    """
    if len(owners):
        _update[(len(owners),)](table, owners, numbers, BLOCK)


def address_table(parameters: Sequence[Sequence[Tensor]]) -> tuple[Tensor, Tensor]:
    """Return addresses, first block and size of each parameter, and the parameter of each block."""
    counts = [row[0].numel() for row in parameters]
    blocks = [triton.cdiv(count, BLOCK) for count in counts]
    first = [sum(blocks[:number]) for number in range(len(blocks))]
    rows = [[*(x.data_ptr() for x in row), *sizes] for row, *sizes in zip(parameters, first, counts, strict=True)]
    owners = torch.arange(len(blocks)).repeat_interleave(torch.tensor(blocks))
    device = parameters[0][0].device
    return torch.tensor(rows).to(device), owners.to(device)


def trial(device: str = "cuda") -> None:
    """Run the kernel once on tiny input; it raises whatever the compiler or driver raises.

    Raises:
        RuntimeError: the result is wrong.
    """
    parameter, grad, first, second = torch.tensor([[1.0, 1.0], [2.0, 0.0], [0.0, 3.0], [0.0, 4.0]], device=device)
    numbers = torch.tensor([[0.5, 1.0, 0.0, 0.0, 1e-15]], device=device)
    adam_steps(*address_table([(parameter, grad, first, second)]), numbers)
    if parameter.tolist() != [0.5, 1.0] or grad.any() or second.tolist() != [4.0, 4.0]:
        raise RuntimeError("a trial of its kernels gave wrong numbers")


@triton.jit
@no_type_check
def _update(table, owners, numbers, block: tl.constexpr):
    program = tl.program_id(0)
    owner = tl.load(owners + program)
    step_size, root_scale = tl.load(numbers + 5 * owner), tl.load(numbers + 5 * owner + 1)
    beta1, beta2 = tl.load(numbers + 5 * owner + 2), tl.load(numbers + 5 * owner + 3)
    eps, row = tl.load(numbers + 5 * owner + 4), table + 6 * owner
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

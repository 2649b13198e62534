"""Adam's step for the CPU, in one pass."""

from typing import no_type_check

import numpy as np
import torch
from numba import njit
from torch import Tensor

from nerf_lightning.nerf.kernels.threads import over_rows


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
    arrays = (x.view(-1).numpy() for x in (parameter, grad, first, second))
    numbers = (np.float32(x) for x in (step_size, root_scale, *betas, eps))
    over_rows(_adam_step, parameter.numel(), *arrays, *numbers)


def trial() -> None:
    """Run the kernel once on next to nothing; it raises whatever its compiler raises."""
    adam_step(torch.ones(4), torch.ones(4), torch.zeros(4), torch.zeros(4), 0.1, 1.0, (0.9, 0.99), 1e-15)


@njit(nogil=True, fastmath=True, cache=True)
@no_type_check
def _adam_step(first_row, last_row, parameter, grad, first, second, step_size, root_scale, beta1, beta2, eps):
    one = np.float32(1.0)
    for i in range(first_row, last_row):
        g = grad[i]
        if g != 0:
            m = beta1 * first[i] + (one - beta1) * g
            v = beta2 * second[i] + (one - beta2) * g * g
            first[i], second[i] = m, v
            parameter[i] -= step_size * m / (np.sqrt(v) * root_scale + eps)
            grad[i] = 0

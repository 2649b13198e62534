"""One step of Adam on the entries with nonzero gradient, which it sets to zero."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import cpu_backend, cuda_backend


def adam_steps(
    parameters: Sequence[tuple[Tensor, Tensor, Tensor, Tensor]],
    step_size: float,
    root_scale: float,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """Take the step of `adam_step_torch` for several parameters on one device; on CUDA in one kernel.

    Args:
        parameters: each with its gradient and its two moments.
        step_size: see `adam_step_torch`, also for the others.
        root_scale: the same for all parameters.
        betas: b1, b2.
        eps: keeps the quotient finite.
    """
    numbers, device = (step_size, root_scale, betas, eps), parameters[0][0].device
    rows = [(row[0].detach(), *row[1:]) for row in parameters]
    suits = [all(x.is_contiguous() and x.dtype == torch.float32 for x in row) for row in rows]
    cuda = cuda_backend("table_adam.cuda", device) if all(suits) else None
    if cuda is not None:
        cuda.adam_steps(rows, *numbers)
        return
    cpu = cpu_backend("table_adam.cpu", device)
    for row, suitable in zip(rows, suits, strict=True):
        (cpu.adam_step if cpu is not None and suitable else adam_step_torch)(*row, *numbers)


def adam_step_torch(
    parameter: Float[Tensor, "*n"],
    grad: Float[Tensor, "*n"],
    first: Float[Tensor, "*n"],
    second: Float[Tensor, "*n"],
    step_size: float,
    root_scale: float,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """Update in place: m = b1 m + (1 - b1) g, v = b2 v + (1 - b2) g^2, p -= step_size m / (root_scale sqrt(v) + eps).

    The reference, for any device and dtype.

    Args:
        parameter: p.
        grad: g; set to zero.
        first: m.
        second: v.
        step_size: learning rate over (1 - b1^t).
        root_scale: 1 / sqrt(1 - b2^t).
        betas: b1, b2.
        eps: keeps the quotient finite.
    """
    touched = (grad != 0).to(grad.dtype)
    first.add_(touched * (1.0 - betas[0]) * (grad - first))
    second.add_(touched * (1.0 - betas[1]) * (grad * grad - second))
    parameter.sub_(touched * step_size * first / (second.sqrt() * root_scale + eps))
    grad.zero_()

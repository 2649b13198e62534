"""One step of Adam on the entries whose gradient is not zero, which it sets to zero."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import backend_for


def adam_step(
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

    Args:
        parameter: p.
        grad: g; zero afterwards.
        first: m.
        second: v.
        step_size: learning rate over (1 - b1^t).
        root_scale: 1 / sqrt(1 - b2^t).
        betas: b1, b2.
        eps: keeps the quotient finite.
    """
    arrays = (parameter.detach(), grad, first, second)
    backend = backend_for("adam", parameter.device)
    if backend is not None and all(x.is_contiguous() and x.dtype == torch.float32 for x in arrays):
        backend.adam_step(*arrays, step_size, root_scale, betas, eps)
    else:
        adam_step_torch(*arrays, step_size, root_scale, betas, eps)


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
    """Do the same in plain torch: the reference, for any device and dtype."""
    touched = (grad != 0).to(grad.dtype)
    first.add_(touched * (1.0 - betas[0]) * (grad - first))
    second.add_(touched * (1.0 - betas[1]) * (grad * grad - second))
    parameter.sub_(touched * step_size * first / (second.sqrt() * root_scale + eps))
    grad.zero_()

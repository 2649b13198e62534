"""One step of Adam on the entries with nonzero gradient, which it sets to zero."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import cpu_backend, cuda_backend
from nerf_lightning.nerf.types.tensor_struct import overwrite

Row = tuple[Tensor, Tensor, Tensor, Tensor]
"""A parameter, its gradient and its two moments."""


class AdamUpdate:
    """The step of `adam_step_torch` for several parameters on one device; on CUDA in one kernel.

    The numbers that vary between steps lie on the device, so a recorded update can be replayed.

    Args:
        rows: each parameter with its gradient and its two moments.
    """

    def __init__(self, rows: Sequence[Row]):
        self.addresses = addresses(rows)
        self.rows = [(row[0].detach(), *row[1:]) for row in rows]
        device = rows[0][0].device
        self.numbers = torch.zeros(len(rows), 5, dtype=torch.float64 if device.type == "cpu" else None, device=device)
        self.suits = [all(x.is_contiguous() and x.dtype == torch.float32 for x in row) for row in self.rows]
        self.cuda = cuda_backend("table_adam.cuda", device) if all(self.suits) else None
        self.table: tuple[Tensor, ...] = () if self.cuda is None else self.cuda.address_table(self.rows)

    def set_numbers(self, numbers: Sequence[tuple[float, float, float, float, float]]) -> None:
        """Set each parameter's step_size, root_scale, b1, b2 and eps."""
        overwrite(self.numbers, np.array(numbers, np.float64 if self.numbers.dtype == torch.float64 else np.float32))

    def __call__(self) -> None:
        """Update the parameters in place."""
        if self.cuda is not None:
            self.cuda.adam_steps(*self.table, self.numbers)
            return
        cpu = cpu_backend("table_adam.cpu", self.numbers.device)
        for row, suitable, numbers in zip(self.rows, self.suits, self.numbers, strict=True):
            if cpu is not None and suitable:
                cpu.adam_step(*row, *numbers.tolist())
            else:
                adam_step_torch(*row, *numbers)

    def tensors(self) -> list[Tensor]:
        """Return what an update changes besides the gradients."""
        return [array for row in self.rows for array in (row[0], *row[2:])]


def addresses(rows: Sequence[Row]) -> list[int]:
    """Return where arrays are: an `AdamUpdate` is for arrays that stay there."""
    return [array.data_ptr() for row in rows for array in row]


def adam_step_torch(
    parameter: Float[Tensor, "*n"],
    grad: Float[Tensor, "*n"],
    first: Float[Tensor, "*n"],
    second: Float[Tensor, "*n"],
    step_size: float | Float[Tensor, ""],
    root_scale: float | Float[Tensor, ""],
    beta1: float | Float[Tensor, ""],
    beta2: float | Float[Tensor, ""],
    eps: float | Float[Tensor, ""],
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
        beta1: b1.
        beta2: b2.
        eps: keeps the quotient finite.
    """
    touched = (grad != 0).to(grad.dtype)
    first.add_(touched * (1.0 - beta1) * (grad - first))
    second.add_(touched * (1.0 - beta2) * (grad * grad - second))
    parameter.sub_(touched * step_size * first / (second.sqrt() * root_scale + eps))
    grad.zero_()

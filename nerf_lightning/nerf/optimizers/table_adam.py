"""Adam for sparse gradients: entries that a step did not touch are left alone (Sec. 4, arXiv 2201.05989).

Its numbers: `conf/optimizer/table_adam.yaml`. Groups of parameters: `groups.py`.
The equations: `adam_step_torch` in `kernels/table_adam/op.py`, repeated in `cpu.py` and `cuda.py`.
"""

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.kernels.table_adam.op import AdamUpdate, addresses


class TableAdam(Optimizer):
    """Adam (arXiv 1412.6980) that skips entries whose gradient is exactly zero, in one pass over memory.

    A batch touches a small part of a hash grid's tables; updating the moments of the rest would cost more than the
    batch, and let entries drift on old momentum. Gradients stay allocated and are accumulated in place
    (`grad_in_place`); the pass that uses them resets them to zero.

    Args:
        params: parameters or groups of them.
        lr: learning rate.
        betas: decay rates of the two moments.
        eps: added to the root of the second moment; tiny, like the gradients of rarely seen entries.
        weight_decay: L2 penalty on matrices; hash tables have none.
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float = 2e-2,
        betas: tuple[float, float] | list[float] = (0.9, 0.95),
        eps: float = 1e-15,
        weight_decay: float = 0.0,
    ):
        in_range = 0 < lr < math.inf and 0 < eps < math.inf and 0 <= weight_decay < math.inf
        if not in_range or not all(0 <= beta < 1 for beta in betas):
            raise InputError(
                f"optimizer: lr={lr}, betas={list(betas)}, eps={eps}, weight_decay={weight_decay}: give a positive lr "
                "and eps, betas from 0 to below 1, and no negative weight_decay."
            )
        super().__init__(params, {"lr": lr, "betas": tuple(betas), "eps": eps, "weight_decay": weight_decay})
        # Shared with copies of this optimizer's attributes, such as Lightning's wrapper.
        self._gradients = {"are_zero": False}
        self.next_update: AdamUpdate | None = None  # of the present parameters, gradients and moments

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Set the gradients to zero unless the last step has; they stay allocated, whatever `set_to_none`."""
        for parameter in self._parameters():
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
                parameter.grad_in_place = True  # type: ignore[attr-defined]
            elif not self._gradients["are_zero"]:
                parameter.grad.zero_()
        self._gradients["are_zero"] = False

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """Update the touched entries, and set their gradients to zero.

        Args:
            closure: computes the gradients; if it also replays a recorded `update`, it calls `gradients_are_zero`.
        """
        self._count_step()
        self._gradients["are_zero"] = False
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        if not self._gradients["are_zero"]:
            self.update()
        return loss

    @torch.no_grad()
    def update(self) -> None:
        """Update with the numbers of the present step, which lie on the device: this can be recorded and replayed."""
        for group in self.param_groups:
            for parameter in group["params"] if group["weight_decay"] else ():
                if parameter.grad is not None:
                    parameter.grad.add_(parameter, alpha=group["weight_decay"])
        if self.next_update is not None:
            self.next_update()
        self.gradients_are_zero()

    def gradients_are_zero(self) -> None:
        """Note that the step's update has been made, and has left zeros."""
        self._gradients["are_zero"] = True

    def _count_step(self) -> None:
        """Count a step, and set its numbers."""
        rows, numbers = [], []
        for group in self.param_groups:
            beta1, beta2 = group["betas"]
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                state = self.state[parameter]
                if not state:
                    state["step"] = 0
                    state["exp_avg"] = torch.zeros_like(parameter)
                    state["exp_avg_sq"] = torch.zeros_like(parameter)
                state["step"] = step = state["step"] + 1
                rows.append((parameter, parameter.grad, state["exp_avg"], state["exp_avg_sq"]))
                rates = group["lr"] / (1.0 - beta1**step), 1.0 / math.sqrt(1.0 - beta2**step)
                numbers.append((*rates, beta1, beta2, group["eps"]))
        if not rows:
            self.next_update = None
            return
        if self.next_update is None or self.next_update.addresses != addresses(rows):
            self.next_update = AdamUpdate(rows)
        self.next_update.set_numbers(numbers)

    def _parameters(self) -> Iterable[Tensor]:
        return (parameter for group in self.param_groups for parameter in group["params"])

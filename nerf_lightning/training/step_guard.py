"""Steps whose gradients are not finite are left out, before they ruin the weights."""

import math
from collections.abc import Iterable

import torch
from torch import Tensor

LARGE = 1 << 20


class StepGuard:
    """Decide whether a step may be taken, and count those that may not; `NanGuard` decides what becomes of the run.

    On the CPU the step is left out. Elsewhere reading the answer would stop the device, so the step is taken with
    gradients of zero.
    """

    def __init__(self) -> None:
        self.counts: Tensor | None = None
        self.first_bad: Tensor | None = None
        self.watched: list[str] = []

    def allows(self, losses: Tensor, parameters: Iterable[tuple[str, Tensor]]) -> bool:
        """Tell whether the step may be taken."""
        # Large tables are left out: what reaches them has passed through the MLPs, whose gradients show it too.
        gradients = {name: parameter.grad for name, parameter in parameters if parameter.grad is not None}
        watched = {name: gradient for name, gradient in gradients.items() if gradient.numel() < LARGE}
        # Few operations, each of which is a launch on a GPU.
        sums = torch._foreach_norm([*watched.values(), losses], ord=1)
        finite, first_bad = (torch.stack(sums) < math.inf).int().min(dim=0)
        if self.counts is None or self.counts.device != finite.device:
            self.counts = torch.zeros(2, dtype=torch.long, device=finite.device)
        bad = 1 - finite
        self.counts = torch.stack([self.counts[0], self.counts[1] * bad]) + bad
        begins = self.counts[1] == 1
        self.first_bad = first_bad if self.first_bad is None else torch.where(begins, first_bad, self.first_bad)
        self.watched = [*watched, "loss.itself"]
        if finite.device.type == "cpu":
            return bool(finite)
        if finite.is_cuda:  # all at once: the bits times 1 or 0, since NaN times 0 is NaN
            torch._foreach_mul_([gradient.view(torch.int32) for gradient in gradients.values()], finite)
        else:
            for gradient in gradients.values():
                gradient.masked_fill_(bad.bool(), 0.0)
        return True

    @property
    def skipped(self) -> int:
        """Steps left out so far."""
        return self.state()[0]

    @property
    def in_row(self) -> int:
        """Steps left out since the last that was taken."""
        return self.state()[1]

    @property
    def first_module(self) -> str:
        """The first module, in the model's order, whose gradients were not finite when the row of bad steps began."""
        return "none" if self.first_bad is None else self.watched[int(self.first_bad)].rpartition(".")[0]

    def state(self) -> list[int]:
        """What a checkpoint keeps."""
        return [0, 0] if self.counts is None else self.counts.tolist()

    def restore(self, state: list[int], device: torch.device) -> None:
        """Take the counts up again."""
        self.counts = torch.tensor(state, device=device)


def first_not_finite(named: Iterable[tuple[str, Tensor]]) -> str | None:
    """Return the first module whose weights are not all finite numbers, or None."""
    names, parameters = zip(*named, strict=True)
    # One read from the device for all.
    finite = torch.stack([torch.isfinite(parameter).all() for parameter in parameters]).tolist()
    return next((name.rpartition(".")[0] for name, good in zip(names, finite, strict=True) if not good), None)

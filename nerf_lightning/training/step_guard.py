"""Skip steps whose gradients are not finite, before they ruin the weights.

How many in a row end a run: `nan_guard` in conf/callbacks/default.yaml.
"""

import math
from collections.abc import Iterable

import torch
from torch import Tensor

LARGE = 1 << 19


class StepGuard:
    """Decide whether a step may be taken, and count those that may not; `NanGuard` decides what happens to the run.

    On the CPU the step is skipped. Elsewhere reading the answer would stall the device, so the step is taken with zero
    gradients.
    """

    def __init__(self) -> None:
        self.counts: Tensor | None = None
        self.first_bad: Tensor | None = None
        self.watched: list[str] = []

    def allows(self, losses: Tensor, parameters: Iterable[tuple[str, Tensor]]) -> bool:
        """Return whether the step may be taken."""
        gradients = _gradients(parameters)
        finite = self._count(losses, gradients)
        if finite.device.type == "cpu":
            return bool(finite)
        _keep_finite(gradients, finite)
        return True

    def keep_finite(self, losses: Tensor, parameters: Iterable[tuple[str, Tensor]]) -> None:
        """Count the step, and set its gradients to zero if it may not be taken; nothing is read on the host."""
        gradients = _gradients(parameters)
        _keep_finite(gradients, self._count(losses, gradients))

    def tensors(self, device: torch.device) -> list[Tensor]:
        """Return the counters, which keep their addresses."""
        if self.counts is None or self.counts.device != device:
            self.counts = torch.zeros(2, dtype=torch.long, device=device)
        if self.first_bad is None or self.first_bad.device != device:
            self.first_bad = torch.zeros((), dtype=torch.long, device=device)
        return [self.counts, self.first_bad]

    def _count(self, losses: Tensor, gradients: dict[str, Tensor]) -> Tensor:
        """Return 1 if everything is finite, else 0."""
        # Large tables are skipped: their gradients have passed through the MLPs, whose gradients show it, too.
        watched = {name: gradient for name, gradient in gradients.items() if gradient.numel() < LARGE}
        # Few operations, each of which is a launch on a GPU.
        sums = torch.stack(torch._foreach_norm([*watched.values(), losses], ord=1))
        finite, first_bad = torch.lt(sums, math.inf, out=sums.new_empty(len(sums), dtype=torch.int32)).min(dim=0)
        counts, former = self.tensors(finite.device)
        bad = 1 - finite
        counts[1:].mul_(bad)
        counts.add_(bad)
        torch.where(counts[1] == 1, first_bad, former, out=former)
        self.watched = [*watched, "loss.itself"]
        return finite

    @property
    def skipped(self) -> int:
        """Number of steps skipped so far."""
        return self.state()[0]

    @property
    def in_row(self) -> int:
        """Number of steps skipped since the last one taken."""
        return self.state()[1]

    @property
    def first_module(self) -> str:
        """The first module, in the model's order, whose gradients were not finite when the row of bad steps began."""
        return "none" if self.first_bad is None else self.watched[int(self.first_bad)].rpartition(".")[0]

    def state(self) -> list[int]:
        """Return the counts for a checkpoint."""
        return [0, 0] if self.counts is None else self.counts.tolist()

    def restore(self, state: list[int], device: torch.device) -> None:
        """Restore the counts."""
        self.tensors(device)[0].copy_(torch.tensor(state))


def _gradients(parameters: Iterable[tuple[str, Tensor]]) -> dict[str, Tensor]:
    return {name: parameter.grad for name, parameter in parameters if parameter.grad is not None}


def _keep_finite(gradients: dict[str, Tensor], finite: Tensor) -> None:
    if finite.device.type in ("cpu", "cuda"):  # all at once: the bits times 1 or 0, since NaN times 0 is NaN
        torch._foreach_mul_([gradient.view(torch.int32) for gradient in gradients.values()], finite)
        return
    for gradient in gradients.values():
        gradient.masked_fill_(finite == 0, 0.0)


def first_not_finite(named: Iterable[tuple[str, Tensor]]) -> str | None:
    """Return the first module whose weights are not all finite numbers, or None."""
    names, parameters = zip(*named, strict=True)
    # One read from the device for all.
    finite = torch.stack([torch.isfinite(parameter).all() for parameter in parameters]).tolist()
    return next((name.rpartition(".")[0] for name, good in zip(names, finite, strict=True) if not good), None)

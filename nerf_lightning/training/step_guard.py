"""Steps whose gradients are not finite are left out, before they ruin the weights."""

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
        sums = [gradient.sum() for gradient in watched.values()]
        broken = ~torch.isfinite(torch.stack([*sums, losses.sum()]))
        bad, first_bad = broken.any(), broken.int().argmax()
        if self.counts is None or self.counts.device != bad.device:
            self.counts = torch.zeros(2, dtype=torch.long, device=bad.device)
        begins = (self.counts[1] == 0) & bad
        self.first_bad = first_bad if self.first_bad is None else torch.where(begins, first_bad, self.first_bad)
        self.watched = [*watched, "loss.itself"]
        self.counts = torch.stack([self.counts[0] + bad, (self.counts[1] + 1) * bad])
        if bad.device.type == "cpu":
            return not bool(bad)
        for gradient in gradients.values():
            gradient.masked_fill_(bad, 0.0)
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

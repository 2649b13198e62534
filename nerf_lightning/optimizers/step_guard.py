"""Steps whose gradients are not finite are left out, before they ruin the weights."""

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from nerf_lightning.errors import InputError

LARGE = 1 << 20


class StepGuard:
    """Decide whether a step may be taken, and count those that may not.

    On the CPU the step is left out. Elsewhere reading the answer would stop the device, so the step is taken with
    gradients of zero, and every `every_steps` steps the count of the steps before is read, which is there already.

    Args:
        patience: so many bad steps in a row end the run.
        every_steps: how often the count is read where reading is dear.
    """

    def __init__(self, patience: int = 10, every_steps: int = 100):
        self.patience, self.every_steps = patience, every_steps
        self.counts: Tensor | None = None

    def allows(self, losses: Tensor, parameters: Iterable[nn.Parameter], step: int) -> bool:
        """Tell whether the step may be taken.

        Raises:
            InputError: too many steps in a row had gradients that are not finite.
        """
        parameters = list(parameters)
        bad = ~torch.isfinite(losses.sum() + _sum_of_gradients(parameters))
        if self.counts is None or self.counts.device != bad.device:
            self.counts = torch.zeros(2, dtype=torch.long, device=bad.device)
        if bad.device.type != "cpu" and step % self.every_steps == 0:
            self.require_progress(step)
        total, in_row = self.counts[0] + bad, (self.counts[1] + 1) * bad
        self.counts = torch.stack([total, in_row])
        if bad.device.type == "cpu":
            self.require_progress(step)
            return not bool(bad)
        for parameter in parameters:
            if parameter.grad is not None:
                parameter.grad.masked_fill_(bad, 0.0)
        return True

    @property
    def skipped(self) -> int:
        """Steps left out so far."""
        return self.state()[0]

    def require_progress(self, step: int) -> None:
        """Read the count.

        Raises:
            InputError: too many bad steps in a row.
        """
        _, in_row = self.state()
        if in_row < self.patience:
            return
        raise InputError(
            f"The loss or its gradients are not a finite number since {in_row} steps (now step {step}), "
            "so nothing is learnt any more; the run stops, and nothing of these steps was kept. Try a smaller "
            "optimizer.lr, gradient clipping (trainer.clip_norm=1), trainer.precision=32-true, or check the capture's "
            "poses, near and far."
        )

    def state(self) -> list[int]:
        """What a checkpoint keeps."""
        return [0, 0] if self.counts is None else self.counts.tolist()

    def restore(self, state: list[int], device: torch.device) -> None:
        """Take the counts up again."""
        self.counts = torch.tensor(state, device=device)


def _sum_of_gradients(parameters: list[nn.Parameter]) -> Tensor:
    # Large tables are left out: what reaches them has passed through the MLPs, whose gradients show it too.
    total = torch.zeros((), device=parameters[0].device)
    for parameter in parameters:
        if parameter.grad is not None and parameter.numel() < LARGE:
            total = total + parameter.grad.sum()
    return total

"""The contract of every part that learns, inside the model or beside it: learning rate, penalty, a hook each step."""

from collections.abc import Iterator
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor, nn


@dataclass(frozen=True)
class StepContext:
    """Where a run stands before a step of training."""

    progress: float
    """Share of the run's steps that have been taken, in [0, 1)."""
    step: int
    """Steps that this attempt has taken."""
    key: int
    """Of the step's random numbers."""


class Part(nn.Module):
    """A module that training asks for its learning rate and penalty, and tells of each step.

    Encoders, fields, samplers, cameras and corrections are parts. All that a step needs of them is found by a walk over
    modules, so a part may sit anywhere.
    """

    learning_rate: float | None = None
    """Initial rate of all its parameters; the run's schedule scales it, and they do not decay. None: the run's."""

    def on_step(self, context: StepContext) -> None:
        """Prepare for the next step of training."""

    def penalty(self) -> Float[Tensor, ""] | None:
        """Return what is added to the loss of each step, once, however the step is cut; None: nothing."""
        return None

    def reset_parameters(self) -> None:
        """Set the parameters to where a new attempt begins; nothing to do where there are none."""


def parts_of(*modules: nn.Module) -> Iterator[Part]:
    """Return every part within modules, each once, outer parts before those inside of them."""
    known: set[int] = set()
    for module in modules:
        for part in module.modules():
            if isinstance(part, Part) and id(part) not in known:
                known.add(id(part))
                yield part

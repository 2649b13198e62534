"""The contract of what learns at a rate of its own: cameras, the colours of photographs, or a part of a model."""

from jaxtyping import Float
from torch import Tensor, nn


class LearntPart(nn.Module):
    """A module of the step, whose parameters may learn at a rate of their own and be held near what is likely."""

    learning_rate: float | None = None
    """Of all its parameters, at the beginning; the run's schedule scales it, and they do not decay. None: the run's."""

    def penalty(self) -> Float[Tensor, ""] | None:
        """Return what is added to the loss of each step, once, however the step is cut; None: nothing."""
        return None

    def reset_parameters(self) -> None:
        """Set the parameters to where a new attempt begins; nothing to do where there are none."""

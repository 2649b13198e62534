"""Schedules: the learning rate as a function of the step alone, so there is no state to lose."""

from abc import ABC, abstractmethod


class Schedule(ABC):
    """A factor on the optimizer's learning rate."""

    @abstractmethod
    def __call__(self, step: int, num_steps: int) -> float:
        """Return the factor for the step that is about to be taken (0 is the first of an attempt).

        `num_steps` is the length of the run; a run that is made longer stretches its schedule.
        """


class ExponentialDecay(Schedule):
    """decay_rate^(step / decay_steps), times (step + 1) / warmup_steps while warming up.

    The paper decays from 5e-4 to 5e-5 over the run; decay_rate=1 keeps the rate constant.

    Args:
        decay_rate: what the learning rate is multiplied by after `decay_steps`.
        decay_steps: steps over which the rate falls by that; None: the length of the run.
        warmup_steps: steps of the linear rise.

    >>> ExponentialDecay(decay_rate=0.1)(50, num_steps=100) == 0.1**0.5
    True
    """

    def __init__(self, decay_rate: float = 0.1, decay_steps: int | None = None, warmup_steps: int = 0):
        if decay_rate <= 0 or warmup_steps < 0 or (decay_steps is not None and decay_steps < 1):
            raise ValueError("decay_rate must be positive, decay_steps at least 1, warmup_steps at least 0")
        self.decay_rate, self.decay_steps, self.warmup_steps = decay_rate, decay_steps, warmup_steps

    def __call__(self, step: int, num_steps: int) -> float:
        """Return the factor for this step."""
        warmup = min(1.0, (step + 1) / self.warmup_steps) if self.warmup_steps else 1.0
        return warmup * self.decay_rate ** (step / (self.decay_steps or num_steps))

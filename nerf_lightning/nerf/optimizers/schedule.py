"""Schedules: the learning rate as a function of only the step, so there is no state to lose.

Which schedule with which numbers: `conf/scheduler/`, chosen by conf/train.yaml and conf/model/.
"""

from abc import ABC, abstractmethod


class Schedule(ABC):
    """A factor on the optimizer's learning rate."""

    @abstractmethod
    def __call__(self, step: int, num_steps: int) -> float:
        """Return the factor for the next step (0 is the first of an attempt).

        `num_steps` is the length of the run; extending a run stretches its schedule.
        """


class ExponentialDecay(Schedule):
    """decay_rate^(step / decay_steps), times (step + 1) / warmup_steps while warming up.

    The paper decays from 5e-4 to 5e-5 over the run; decay_rate=1 keeps the rate constant.

    Args:
        decay_rate: the factor of the learning rate after `decay_steps`.
        decay_steps: steps after which the rate has decayed by that factor; None: the length of the run.
        warmup_steps: steps of the linear warm-up.

    >>> ExponentialDecay(decay_rate=0.1)(50, num_steps=100) == 0.1**0.5
    True
    """

    def __init__(self, decay_rate: float = 0.1, decay_steps: int | None = None, warmup_steps: int = 0):
        if decay_rate <= 0 or warmup_steps < 0 or (decay_steps is not None and decay_steps < 1):
            raise ValueError("decay_rate must be positive, decay_steps at least 1, warmup_steps at least 0")
        self.decay_rate, self.decay_steps, self.warmup_steps = decay_rate, decay_steps, warmup_steps

    def __call__(self, step: int, num_steps: int) -> float:
        """Return the factor for this step."""
        return _warmup(step, self.warmup_steps) * self.decay_rate ** (step / (self.decay_steps or num_steps))


class Cooldown(Schedule):
    """Full rate at first, then linear decay to zero (arXiv 2405.18392), times a linear warm-up.

    A rate that stays high gets farther in a short run than one that decays from the beginning, and the decay to zero
    removes the noise that it leaves.

    Args:
        cooldown: share of the run, at its end, in which the rate decays.
        warmup_steps: steps of the linear warm-up.

    >>> [Cooldown(cooldown=0.5)(step, num_steps=64) for step in (0, 32, 48, 64)]
    [1.0, 1.0, 0.5, 0.0]
    """

    def __init__(self, cooldown: float = 0.5, warmup_steps: int = 0):
        if not 0 < cooldown <= 1 or warmup_steps < 0:
            raise ValueError("cooldown must be above 0 and at most 1, warmup_steps at least 0")
        self.cooldown, self.warmup_steps = cooldown, warmup_steps

    def __call__(self, step: int, num_steps: int) -> float:
        """Return the factor for this step."""
        left = max(0.0, 1.0 - step / num_steps)
        return _warmup(step, self.warmup_steps) * min(1.0, left / self.cooldown)


def _warmup(step: int, steps: int) -> float:
    return min(1.0, (step + 1) / steps) if steps else 1.0

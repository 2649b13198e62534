"""The contract of a schedule: the learning rate as a function of the step alone, so there is no state to lose."""

from abc import ABC, abstractmethod


class Schedule(ABC):
    """A factor on the optimizer's learning rate."""

    @abstractmethod
    def __call__(self, step: int, num_steps: int) -> float:
        """Return the factor for the step that is about to be taken (0 is the first of an attempt).

        `num_steps` is the length of the run; a run that is made longer stretches its schedule.
        """

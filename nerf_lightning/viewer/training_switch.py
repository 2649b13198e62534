"""What a person in the page asks of the training: to pause, to go on, to stop."""

import time
from collections.abc import Callable

# A page that is loaded again is away for a moment; whoever is away for longer has left.
AWAY_SECONDS = 15.0


class TrainingSwitch:
    """Wishes of the pages, for the thread that trains.

    Args:
        can_pause: whether it may pause: several processes wait for each other only for a while.
    """

    def __init__(self, can_pause: bool = True):
        self.can_pause = can_pause
        self.step, self.num_steps = 0, 0
        """How far the training is."""
        self.wants_pause = self.wants_stop = False
        self.on_change: dict[int, Callable[[], None]] = {}
        """What shows each person how it stands, by their number."""

    def pause(self) -> None:
        """Let the training wait after the step that is being taken."""
        self.wants_pause = self.can_pause
        self.show()

    def go_on(self) -> None:
        """Let it go on."""
        self.wants_pause = False
        self.show()

    def stop(self) -> None:
        """End it after the step that is being taken, as if that had been its last: saved, and evaluated."""
        self.wants_stop, self.wants_pause = True, False
        self.show()

    def pause_while(
        self, work: Callable[[], None], is_anybody_here: Callable[[], bool], ends: Callable[[], bool]
    ) -> float:
        """Do other work until somebody lets the training go on, or nobody is left; return for how many seconds.

        Args:
            work: a slice of the other work, which takes at least a moment.
            is_anybody_here: whether somebody could still let it go on.
            ends: whether it must not wait any longer.
        """
        began = seen = time.monotonic()
        while self.wants_pause and not ends():
            work()
            now = time.monotonic()
            if is_anybody_here():
                seen = now
            elif now - seen > AWAY_SECONDS:
                self.go_on()
        return time.monotonic() - began

    def count(self, step: int, num_steps: int) -> None:
        """Say how far the training is."""
        self.step, self.num_steps = step, num_steps

    def show(self) -> None:
        """Let every page show how it stands."""
        for show in list(self.on_change.values()):
            show()

"""Requests of the page's users to the training: pause, resume, stop.

When training obeys them, after each step: `live_view.py`.
"""

import time
from collections.abc import Callable

from nerf_lightning.extensions.viewer.client import ViewerClient

AWAY_SECONDS = 15.0  # A page that is reloaded is away for a moment; a user who is away for longer has left.
PAUSE, GO_ON = "Pause", "Resume"
STOP, SURE = "Stop training", "Really stop: press again"
SURE_SECONDS = 8.0  # Maximum time until the second press.
WHAT_STOP_IS = "The checkpoint is written, and the run evaluated."


class TrainingSwitch:
    """Requests of the pages, for the training thread.

    Args:
        can_pause: whether it may pause: several processes wait for each other only for a limited time.
    """

    def __init__(self, can_pause: bool = True):
        self.can_pause = can_pause
        self.step, self.num_steps = 0, 0
        """Progress of the training; its owner sets them."""
        self.wants_pause = self.wants_stop = False
        self.on_change: dict[int, Callable[[], None]] = {}
        """Callbacks that show each user the state, by client ID."""

    def pause(self) -> None:
        """Pause the training after the current step."""
        self.wants_pause = self.can_pause
        self.show()

    def go_on(self) -> None:
        """Resume the training."""
        self.wants_pause = False
        self.show()

    def stop(self) -> None:
        """End it after the current step, as if that were its last: it is saved and evaluated."""
        self.wants_stop, self.wants_pause = True, False
        self.show()

    def pause_while(
        self, work: Callable[[], None], is_anybody_here: Callable[[], bool], ends: Callable[[], bool]
    ) -> float:
        """Do other work until a user resumes the training, or no user is left; return the duration in seconds.

        Each call of `work` takes at least a moment; `ends` returns whether the training must stop waiting.
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

    def show(self) -> None:
        """Show the state on every page."""
        for show in list(self.on_change.values()):
            show()

    @property
    def state(self) -> str:
        """The state in words."""
        how = "Stopping at" if self.wants_stop else "Paused at" if self.wants_pause else "Running:"
        far = f"step {self.step:,} of {self.num_steps:,}" if self.num_steps else "the first step"
        return f"{how} {far}. {WHAT_STOP_IS if self.wants_stop else ''}".strip()


class TrainingPanel:
    """The panel's section in which one user can pause or end the training."""

    def __init__(self, session: ViewerClient, switch: TrainingSwitch):
        self.session, self.switch = session, switch
        self._last_press = 0.0
        gui, harmless = session.client.gui, session.queue.errors.harmless
        with gui.add_folder("Training"):
            self.said = gui.add_markdown("")
            self.hold = gui.add_button(PAUSE, visible=switch.can_pause, hint="Training waits until Resume is pressed")
            self.end = gui.add_button(STOP, color="gray", hint=WHAT_STOP_IS)
        self.hold.on_click(harmless(lambda _: switch.go_on() if switch.wants_pause else switch.pause()))
        self.end.on_click(harmless(lambda _: self._stop()))
        switch.on_change[session.client.client_id] = harmless(self.show)
        self.show()

    def show(self) -> None:
        """Show the state."""
        switch = self.switch
        if not self.session.is_here():
            switch.on_change.pop(self.session.client.client_id, None)
            return
        self.hold.label = GO_ON if switch.wants_pause else PAUSE
        self.hold.visible = switch.can_pause and not switch.wants_stop
        self.end.visible = not switch.wants_stop
        if time.monotonic() - self._last_press > SURE_SECONDS:
            self.end.label = STOP
        self.said.content = switch.state

    def _stop(self) -> None:
        now = time.monotonic()
        if now - self._last_press < SURE_SECONDS:
            self.switch.stop()
        self._last_press = now
        self.end.label = SURE

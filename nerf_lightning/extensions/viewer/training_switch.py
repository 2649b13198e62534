"""What a person in the page asks of the training: to pause, to go on, to stop."""

import time
from collections.abc import Callable

from nerf_lightning.extensions.viewer.client import ViewerClient

AWAY_SECONDS = 15.0  # A page that is loaded again is away for a moment; whoever is away for longer has left.
PAUSE, GO_ON = "Pause", "Go on"
STOP, SURE = "Stop training", "Really stop: press again"
SURE_SECONDS = 8.0  # How long the second press is waited for.
WHAT_STOP_IS = "The checkpoint is written, and the run evaluated."


class TrainingSwitch:
    """Wishes of the pages, for the thread that trains.

    Args:
        can_pause: whether it may pause: several processes wait for each other only for a while.
    """

    def __init__(self, can_pause: bool = True):
        self.can_pause = can_pause
        self.step, self.num_steps = 0, 0
        """How far the training is; its owner sets them."""
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

        Each call of `work` takes at least a moment; `ends` says that the training must not wait any longer.
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
        """Let every page show how it stands."""
        for show in list(self.on_change.values()):
            show()

    @property
    def state(self) -> str:
        """How it stands, in words."""
        how = "Stopping at" if self.wants_stop else "Paused at" if self.wants_pause else "Running:"
        far = f"step {self.step:,} of {self.num_steps:,}" if self.num_steps else "the first step"
        return f"{how} {far}. {WHAT_STOP_IS if self.wants_stop else ''}".strip()


class TrainingPanel:
    """The panel's part that lets one person hold or end the training."""

    def __init__(self, session: ViewerClient, switch: TrainingSwitch):
        self.session, self.switch = session, switch
        self._asked = 0.0
        gui, harmless = session.client.gui, session.queue.errors.harmless
        with gui.add_folder("Training"):
            self.said = gui.add_markdown("")
            self.hold = gui.add_button(
                PAUSE, visible=switch.can_pause, hint="Training waits until somebody presses Go on"
            )
            self.end = gui.add_button(STOP, color="gray", hint=WHAT_STOP_IS)
        self.hold.on_click(harmless(lambda _: switch.go_on() if switch.wants_pause else switch.pause()))
        self.end.on_click(harmless(lambda _: self._stop()))
        switch.on_change[session.client.client_id] = harmless(self.show)
        self.show()

    def show(self) -> None:
        """Show how it stands."""
        switch = self.switch
        if not self.session.is_here():
            switch.on_change.pop(self.session.client.client_id, None)
            return
        self.hold.label = GO_ON if switch.wants_pause else PAUSE
        self.hold.visible = switch.can_pause and not switch.wants_stop
        self.end.visible = not switch.wants_stop
        if time.monotonic() - self._asked > SURE_SECONDS:
            self.end.label = STOP
        self.said.content = switch.state

    def _stop(self) -> None:
        now = time.monotonic()
        if now - self._asked < SURE_SECONDS:
            self.switch.stop()
        self._asked = now
        self.end.label = SURE

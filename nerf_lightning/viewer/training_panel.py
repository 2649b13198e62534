"""The panel's part for the training that is looked at: how far it is; pause, go on, stop."""

import time

from nerf_lightning.viewer.client import ViewerClient
from nerf_lightning.viewer.training_switch import TrainingSwitch

PAUSE, GO_ON = "Pause", "Go on"
STOP, SURE = "Stop training", "Really stop: press again"
# How long the second press is waited for.
SURE_SECONDS = 8.0
WHAT_STOP_IS = "The checkpoint is written, and the run evaluated."


class TrainingPanel:
    """Let one person hold or end the training.

    Args:
        session: theirs.
        switch: the training's.
    """

    def __init__(self, session: ViewerClient, switch: TrainingSwitch):
        self.session, self.switch = session, switch
        self._asked = 0.0
        gui, harmless = session.client.gui, session.queue.complaints.harmless
        with gui.add_folder("Training"):
            self.said = gui.add_markdown("")
            self.hold = gui.add_button(PAUSE, visible=switch.can_pause, hint="No step is taken until somebody lets it")
            self.end = gui.add_button(STOP, color="gray", hint=WHAT_STOP_IS)
        self.hold.on_click(harmless(lambda _: switch.go_on() if switch.wants_pause else switch.pause()))
        self.end.on_click(harmless(lambda _: self._stop()))
        switch.on_change[session.client.client_id] = harmless(self.show)
        self.show()

    def show(self) -> None:
        """Show how it stands."""
        if not self.session.is_here():
            self.switch.on_change.pop(self.session.client.client_id, None)
            return
        switch = self.switch
        self.hold.label = GO_ON if switch.wants_pause else PAUSE
        self.hold.visible = switch.can_pause and not switch.wants_stop
        self.end.visible = not switch.wants_stop
        if time.monotonic() - self._asked > SURE_SECONDS:
            self.end.label = STOP
        self.said.content = self._state()

    def _stop(self) -> None:
        now = time.monotonic()
        if now - self._asked < SURE_SECONDS:
            self.switch.stop()
        self._asked = now
        self.end.label = SURE

    def _state(self) -> str:
        switch = self.switch
        how = "Stopping at" if switch.wants_stop else "Paused at" if switch.wants_pause else "Running:"
        far = f"step {switch.step:,} of {switch.num_steps:,}" if switch.num_steps else "the first step"
        return f"{how} {far}. {WHAT_STOP_IS if switch.wants_stop else ''}".strip()

"""Choose whose picture is rendered next: the clients of the viewer take turns, with one slice each."""

import logging
import signal
import threading
import time

from nerf_lightning.extensions.viewer.error_log import ErrorLog
from nerf_lightning.extensions.viewer.progressive import ProgressiveRendering
from nerf_lightning.extensions.viewer.renderer import SlicedRenderer

IDLE_SECONDS = 0.2

log = logging.getLogger(__name__)


class RenderQueue:
    """All rendering, in the thread that calls `work`: the kernels do not support a second one."""

    def __init__(self, renderer: SlicedRenderer):
        self.renderer = renderer
        self.errors = ErrorLog(log)
        self._refinements: dict[int, ProgressiveRendering] = {}
        self._lock = threading.Lock()
        self._wish = threading.Event()

    def add(self, client: int, refinement: ProgressiveRendering) -> None:
        """Render for a client from now on."""
        with self._lock:
            self._refinements[client] = refinement
        self.wake()

    def remove(self, client: int) -> None:
        """Stop rendering for a client that has left."""
        with self._lock:
            self._refinements.pop(client, None)

    def serves(self, client: int) -> bool:
        """Return whether a client is still connected."""
        return client in self._refinements

    def wake(self) -> None:
        """Signal that a client wants another picture."""
        self._wish.set()

    def refresh(self) -> None:
        """Render all pictures again: the model has changed."""
        with self._lock:
            for refinement in self._refinements.values():
                refinement.refresh()

    def work(self) -> bool:
        """Render one slice for one client; return False if all have the picture that they want.

        Clients with moving cameras come first; among equals, the one that has waited longest. A picture that cannot be
        rendered is dropped: it affects neither the other clients' pages nor a training.
        """
        self._wish.clear()
        with self._lock:
            in_order = sorted(self._refinements.values(), key=lambda each: (not each.is_moving, each.served))
        for refinement in in_order:
            refinement.served = time.monotonic()
            try:
                if refinement.work(self.renderer):
                    return True
            except Exception as error:
                refinement.give_up()
                self.errors.say("an image of the viewer could not be rendered", error)
                return True
        return False

    def work_or_wait(self, seconds: float = IDLE_SECONDS) -> None:
        """Render a slice; if nothing is left to do, sleep until a client wants more, or for this time."""
        if not self.work():
            self._wish.wait(seconds)

    @property
    def is_empty(self) -> bool:
        """Whether there is no client."""
        return not self._refinements


def received_stop_signals() -> list[int]:
    """Return a list that collects SIGINT and SIGTERM from now on; the current slice is finished first."""
    received: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: received.append(number))
    return received

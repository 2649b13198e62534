"""A camera path played in the page: the person's own camera goes along it."""

import threading
import time
from collections.abc import Callable

from nerf_lightning.viewer.client import ViewerClient
from nerf_lightning.viewer.recorded_path import RecordedPath

# Views a second: more than coarse pictures come would only queue.
PER_SECOND = 12


class PathPlayer:
    """Move one person's camera along a path, in a thread of its own.

    Args:
        session: theirs.
        path: what is played.
        on_time: called with the seconds from the beginning, for each view.
        on_end: called when it is over, or was stopped.
    """

    def __init__(
        self, session: ViewerClient, path: RecordedPath, on_time: Callable[[float], None], on_end: Callable[[], None]
    ):
        self.session, self.path = session, path
        self.on_time, self.on_end = on_time, on_end
        self._stop: threading.Event | None = None

    @property
    def is_playing(self) -> bool:
        """Whether the camera moves by itself."""
        return self._stop is not None

    def show(self, seconds: float) -> None:
        """Take the camera to where the path is at a time.

        Raises:
            InputError: no curve passes through the keyframes.
        """
        curve = self.path.curve()
        if curve is not None:
            self.session.go(*self.path.view_at(curve, seconds))

    def play(self, begin: float) -> None:
        """Play from this time (seconds) to the end; from the beginning where that is the end.

        Raises:
            InputError: no curve passes through the keyframes.
        """
        self.stop()
        curve = self.path.curve()
        if curve is None:
            return
        begin = begin if begin < self.path.seconds - 1 / PER_SECOND else 0.0
        self._stop = stop = threading.Event()

        def go() -> None:
            began = time.monotonic()
            while not stop.is_set() and self.session.is_here():
                seconds = min(begin + time.monotonic() - began, self.path.seconds)
                self.session.go(*self.path.view_at(curve, seconds))
                self.on_time(seconds)
                if seconds >= self.path.seconds:
                    break
                stop.wait(1 / PER_SECOND)
            if self._stop is stop:
                self._stop = None
            if not self.is_playing:
                self.session.level()
                self.on_end()

        threading.Thread(target=self.session.queue.complaints.harmless(go), daemon=True).start()

    def stop(self) -> None:
        """Leave the camera where it is."""
        if self._stop is not None:
            self._stop.set()
            self._stop = None

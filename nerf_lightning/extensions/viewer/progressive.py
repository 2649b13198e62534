"""One user's picture: coarse at once, then progressively finer while the request is unchanged.

How coarse: `SlicedRenderer.height_while_moving` in `renderer.py`; during training, MOVING_SECONDS in `live_view.py`.
The quality of its JPEG: QUALITY in `client.py`.
"""

from collections.abc import Callable, Generator
from dataclasses import dataclass

from nerf_lightning.extensions.viewer.camera_state import CameraState
from nerf_lightning.extensions.viewer.renderer import SlicedRenderer, View

# Factor of the height from one picture to the next; it may be larger for the last one.
FINER, AT_MOST_FINER = 2, 2.5
# A picture has at most this many times most_height x most_height pixels; windows wider than 4:1 get a coarser one.
MOST_SQUARES = 4


@dataclass(frozen=True)
class Job:
    """A picture that is being rendered."""

    state: CameraState
    height: int
    is_coarse: bool
    slices: Generator[None, None, View]


class ProgressiveRendering:
    """Render the requested camera state, a slice at a time.

    A finer picture is dropped between two slices if the request has changed. A coarse one is finished and shown: it is
    small, and a user who never stops moving would otherwise see nothing.

    Requests come from other threads than the rendering one; a request is one reference, so no lock is needed. `show`
    takes each finished view, and whether it is the finest; none is higher than `most_height` pixels.
    """

    def __init__(self, show: Callable[[View, CameraState, bool], None], most_height: int = 720):
        self.show, self.most_height = show, most_height
        self.wish: CameraState | None = None
        self.displayed: CameraState | None = None
        self.displayed_height = 0
        self.is_stale = False
        self.served = 0.0
        """Time of its last turn (the queue's clock)."""
        self._job: Job | None = None
        self._tried: CameraState | None = None
        """The camera state of the last job."""

    def ask(self, state: CameraState) -> None:
        """Request another camera state."""
        self.wish = state

    def refresh(self) -> None:
        """Render the finest picture again: the model has changed, or a user wants to save it."""
        self.is_stale = True

    def give_up(self) -> None:
        """Drop what could not be rendered or shown, and wait for another request, or for another model."""
        self.displayed, self.displayed_height = self._tried, self.most_height
        self._job = None

    @property
    def is_moving(self) -> bool:
        """Whether nothing has been shown of the current request yet."""
        return self.wish is not self.displayed

    def work(self, renderer: SlicedRenderer) -> bool:
        """Render a slice; return False if nothing is left to do."""
        if self._job is not None and self._job.state is not self.wish and not self._job.is_coarse:
            self._job.slices.close()
            self._job = None
        if self._job is None:
            self._job = self._next_job(renderer)
        if self._job is None:
            return False
        try:
            next(self._job.slices)
        except StopIteration as end:
            job, self._job = self._job, None
            self.displayed, self.displayed_height = job.state, job.height
            self.show(end.value, job.state, job.height == self._full_height(job.state))
        return True

    def _next_job(self, renderer: SlicedRenderer) -> Job | None:
        state = self._tried = self.wish
        if state is None:
            return None
        full = self._full_height(state)
        if state is not self.displayed:
            height = min(full, renderer.height_while_moving(state))
            return Job(state, height, True, renderer.slices(state, height))
        if self.displayed_height >= full and not self.is_stale:
            return None
        height = full if AT_MOST_FINER * self.displayed_height >= full else FINER * self.displayed_height
        if height == full:
            self.is_stale = False
        return Job(state, height, False, renderer.slices(state, height))

    def _full_height(self, state: CameraState) -> int:
        widest = int(self.most_height * (MOST_SQUARES * state.height / state.width) ** 0.5)
        return max(1, min(state.height, self.most_height, widest))

"""What went wrong for the clients of the viewer: one line in the log for each error, and a bounded number of lines."""

import functools
import logging
from collections.abc import Callable
from typing import Any

from nerf_lightning.viewer.limits import MOST_COMPLAINTS
from nerf_lightning.viewer.plain_text import one_line


class Complaints:
    """Log errors that end one drawing, one click or one connection, and nothing else.

    A client can make things go wrong as often as it likes, and must not fill a log or a terminal by that.

    Args:
        log: where the lines go.
    """

    def __init__(self, log: logging.Logger):
        self.log = log
        self._said: set[str] = set()

    def say(self, what: str, error: BaseException | None = None) -> None:
        """Log a line unless it was logged before."""
        line = what if error is None else f"{what}: {type(error).__name__}: {one_line(str(error))}"
        if line in self._said or len(self._said) >= MOST_COMPLAINTS:
            return
        self._said.add(line)
        self.log.warning("%s", line)

    def harmless(self, act: Callable[..., None]) -> Callable[..., None]:
        """Return an act for viser to call, whose errors are a line here in place of viser's traceback."""

        @functools.wraps(act)
        def careful(*arguments: Any) -> None:
            try:
                act(*arguments)
            except Exception as error:
                self.say("the viewer did not do what somebody clicked", error)

        return careful

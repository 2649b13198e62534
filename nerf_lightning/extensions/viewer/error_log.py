"""Errors of the viewer's users, as lines in the log."""

import functools
import logging
from collections.abc import Callable
from typing import Any

from nerf_lightning.messages.escaping import for_terminal

MOST_LINES, MOST_LETTERS = 20, 5000


class ErrorLog:
    """Log errors of one drawing or one click, each once and not too many: they may recur with every picture."""

    def __init__(self, log: logging.Logger):
        self.log = log
        self._said: set[str] = set()

    def say(self, what: str, error: BaseException) -> None:
        """Log a line unless it was already logged."""
        line = for_terminal(f"{what}: {type(error).__name__}: {error}", MOST_LETTERS)
        if line not in self._said and len(self._said) < MOST_LINES:
            self._said.add(line)
            self.log.warning("%s", line)

    def harmless(self, act: Callable[..., None]) -> Callable[..., None]:
        """Wrap a callback for viser so that its errors are logged as a line instead of viser's traceback."""

        @functools.wraps(act)
        def careful(*arguments: Any) -> None:
            try:
                act(*arguments)
            except Exception as error:
                self.say("a request of the viewer's page failed", error)

        return careful

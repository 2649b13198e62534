"""What went wrong for those who look on, as lines in the log; and text that others wrote, as text in the page."""

import functools
import logging
import re
from collections.abc import Callable
from typing import Any

MOST_LINES = 20
MOST_LETTERS = 5000


class ErrorLog:
    """Log errors that end one drawing or one click, each once and not too many: they may come with every picture."""

    def __init__(self, log: logging.Logger):
        self.log = log
        self._said: set[str] = set()

    def say(self, what: str, error: BaseException) -> None:
        """Log a line unless it was logged before."""
        line = f"{what}: {type(error).__name__}: {one_line(str(error))}"
        if line not in self._said and len(self._said) < MOST_LINES:
            self._said.add(line)
            self.log.warning("%s", line)

    def harmless(self, act: Callable[..., None]) -> Callable[..., None]:
        """Return an act for viser to call, whose errors are a line here in place of viser's traceback."""

        @functools.wraps(act)
        def careful(*arguments: Any) -> None:
            try:
                act(*arguments)
            except Exception as error:
                self.say("a request of the viewer's page failed", error)

        return careful


def as_plain_markdown(text: str) -> str:
    """Return markdown that shows a text and nothing else: viser's page runs the HTML that stands in markdown.

    A code span is the one place where markdown takes every letter as it is, addresses too: they become no links.

    >>> as_plain_markdown("<b>`x`</b>")
    '``<b>`x`</b>``'
    """
    shown = one_line(text)
    longest = max(map(len, re.findall("`+", shown)), default=0)
    fence = "`" * (longest + 1)
    beside = " " if shown[:1] in ("`", " ", "") or shown[-1:] in ("`", " ") else ""
    return f"{fence}{beside}{shown}{beside}{fence}"


def one_line(text: str, most: int = MOST_LETTERS) -> str:
    """Return a text on one line without control characters, cut where it is long.

    >>> one_line("a\\nb\\x1b[0m")
    'a b\\ufffd[0m'
    """
    cut = text if len(text) <= most else f"{text[:most]}…"
    return "".join(letter if letter.isprintable() else " " if letter.isspace() else "\ufffd" for letter in cut)

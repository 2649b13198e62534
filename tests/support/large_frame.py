"""Room for the frames of Python functions in one piece.

CPython keeps frames in pieces of 16 KB, and gives a piece back as soon as its last frame ends. A loop whose calls cross
the edge of a piece then takes and returns memory in each round, which at the depth of pytest's own calls was a fifth of
the time of tests that call `nerf`. A function whose own frame is large opens a piece of twice its size, and what it
calls has the rest.
"""

from collections.abc import Callable
from typing import Any

WORDS = 70_000
"""A little more than half of 1 MB: what is left is enough for some thousand frames. None of it is written to."""


def in_large_frame(call: Callable, *arguments: Any, **options: Any) -> Any:
    """Call something that will call much, and return what it returned."""
    return call(*arguments, **options)


in_large_frame.__code__ = in_large_frame.__code__.replace(co_stacksize=WORDS)

"""`nerf` as a process of its own, which ends without taking apart what it has loaded: that takes over a second."""

import atexit
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

FAILED = 1


def main() -> None:
    """Run the command line, and end."""
    with quick_end():
        from nerf_lightning.cli.main import main as answer

        answer()


@contextmanager
def quick_end() -> Iterator[None]:
    """Let this process end soon after the block: nothing that Python has loaded is taken apart.

    Threads are waited for, and what is registered for the end is done, as ever. An error that nobody has caught, or a
    stream that cannot be flushed, is Python's to tell: then it ends as it would without this.
    """
    ending = QuickEnd()
    try:
        yield
        ending.code = 0
    except SystemExit as stop:
        ending.code = _exit_code(stop)
        raise


class QuickEnd:
    """What ends this process once all else is done that is registered for its end, if the exit code is known.

    It is to be made before most others are imported: what is registered first is called last.
    """

    code: int | None = None

    def __init__(self) -> None:
        atexit.register(self._leave)

    def _leave(self) -> None:
        if self.code is None:
            return
        logging.shutdown()  # registered before, where logging was loaded before
        try:
            for stream in (sys.stdout, sys.stderr):
                if stream is not None:
                    stream.flush()
        except (OSError, ValueError):  # a full disk; a stream that is closed
            return
        os._exit(self.code)


def _exit_code(stop: SystemExit) -> int:
    if stop.code is None:
        return 0
    return stop.code & 0xFF if isinstance(stop.code, int) else FAILED

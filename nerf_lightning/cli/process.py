"""`nerf` as a process of its own, which ends without taking apart what it has loaded: that takes over a second."""

import atexit
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

FAILED = 1


def main() -> None:
    """Run the command line, and end."""
    with quick_end():
        from nerf_lightning.cli.main import main as answer
        from nerf_lightning.cli.working_directory import keep_from_subprocesses

        keep_from_subprocesses()
        answer()


@contextmanager
def quick_end() -> Iterator[None]:
    """End this process after the block: nothing that Python has loaded is taken apart.

    Threads are waited for, and what is registered for the end is done, as ever. An error that nobody has caught, or a
    stream that cannot be flushed, is Python's to tell: then it ends as it would without this.
    """
    try:
        yield
    except SystemExit as stop:
        _end(_exit_code(stop))
        raise
    _end(0)


def _exit_code(stop: SystemExit) -> int:
    if stop.code is None or isinstance(stop.code, int):
        return (stop.code or 0) & 0xFF
    print(stop.code, file=sys.stderr)
    stop.code = FAILED
    return FAILED


def _end(code: int) -> None:
    # What multiprocessing does at the end of its processes.
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    try:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
    except (OSError, ValueError):  # a full disk; a stream that is closed
        return
    os._exit(code)

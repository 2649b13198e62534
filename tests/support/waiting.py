"""What would wait for ever is ended, and fails its test."""

import contextlib
import os
import signal
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def within(seconds: int) -> Iterator[None]:
    """End what takes longer; opening a FIFO waits until then."""

    def expire(number: int, frame: object) -> None:
        raise AssertionError(f"still waiting after {seconds} s")

    former = signal.signal(signal.SIGALRM, expire)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, former)


def fifo(path: Path) -> Path:
    """Put a named pipe, into which nobody writes, in the place of a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    os.mkfifo(path)
    return path

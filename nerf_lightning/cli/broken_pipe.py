"""Readers that leave: `nerf train --help | head -1` ends as quietly as `yes | head -1`."""

import os
import select
import sys
from collections.abc import Iterator
from contextlib import contextmanager

READER_LEFT = 141
"""128 + SIGPIPE, what a shell says of `yes` too; a sweep takes it for a stop, not for a job that failed."""
STDOUT, STDERR = 1, 2


@contextmanager
def ends_quietly() -> Iterator[None]:
    """Exit with READER_LEFT, without a word, where nobody reads what is printed any more.

    Raises:
        OSError: what was printed cannot be written for another reason, such as a full disk.
    """
    try:
        try:
            yield
        except SystemExit:
            _flush()
            raise
        _flush()
    except BrokenPipeError:
        # The pipe may be another one: to a worker, to a film's encoder. That is told like any error.
        unread = _without_reader()
        if not unread:
            raise
        for descriptor in unread:
            _silence(descriptor)
        sys.exit(READER_LEFT)
    except OSError:
        _silence_if_full()
        raise


def _flush() -> None:
    # What waits in the buffer would fail at the interpreter's end, where nobody can catch it.
    if sys.stdout is not None:
        sys.stdout.flush()


def _without_reader() -> list[int]:
    if not hasattr(select, "poll"):  # Windows
        return [STDOUT]
    poll = select.poll()
    for descriptor in (STDOUT, STDERR):
        poll.register(descriptor, 0)
    return [descriptor for descriptor, event in poll.poll(0) if event & (select.POLLERR | select.POLLHUP)]


def _silence_if_full() -> None:
    try:
        _flush()
    except OSError:
        _silence(STDOUT)


def _silence(descriptor: int) -> None:
    """Let what is still buffered go nowhere: Python flushes at its end again, and would complain."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, descriptor)
    os.close(nowhere)

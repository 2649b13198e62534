"""How a test tries many damaged files: how many, and what each may do."""

import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, settings

from nerf_lightning.messages.errors import InputError

TIMES = int(os.environ.get("FUZZ_TIMES", "0"))
"""How many times as many cases are tried as in `make test`, with seeds of their own; 0: those of `make test`."""
SECONDS = 20
"""Of the processor; a case takes some milliseconds."""
GIGABYTE = 1 << 30


class Hang(BaseException):
    """Report a case that goes on for too long; nothing that expects damaged files catches it."""


def fuzzed(cases: int) -> settings:
    """Return the settings of a test that tries so many cases in `make test`, the same ones each time."""
    return settings(
        max_examples=cases * (TIMES or 1),
        derandomize=not TIMES,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        print_blob=True,
        report_multiple_bugs=False,
    )


def harmless(read: Callable[..., Any], *arguments: Any, **settings: Any) -> Any:
    """Call what reads a damaged file, and expect a result or one paragraph, soon and in bounded memory.

    Any other exception is the test's failure, and so is a signal.

    Returns:
        What was read; None where it was refused.
    """
    try:
        with _bounded(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # PIL's and numpy's, of damaged numbers
            result = read(*arguments, **settings)
    except InputError as error:
        if "\n" in str(error):
            raise AssertionError(f"more than one paragraph: {error}") from error
        return None
    return result


@contextmanager
def _bounded() -> Iterator[None]:
    if os.name != "posix":
        yield
        return
    import resource  # not on Windows

    def stop(*_: object) -> None:
        raise Hang(f"more than {SECONDS} s")

    before, limits = _restarted_peak(), resource.getrlimit(resource.RLIMIT_AS)
    former = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    if before:
        # What asks for more than the machine has is told no, and shows as a `MemoryError`.
        resource.setrlimit(resource.RLIMIT_AS, (_status("VmSize") + 8 * GIGABYTE, limits[1]))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, former)
        resource.setrlimit(resource.RLIMIT_AS, limits)
    grown = _status("VmHWM") - before if before else 0
    assert grown < GIGABYTE, f"{grown:,} bytes of memory"


def _restarted_peak() -> int:
    """Return the resident memory, from which its peak is counted anew; 0 where that is not known."""
    if sys.platform != "linux":
        return 0
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return 0
    return _status("VmRSS")


def _status(key: str) -> int:
    lines = Path("/proc/self/status").read_text()
    return 1024 * int(lines.split(f"{key}:")[1].split()[0])

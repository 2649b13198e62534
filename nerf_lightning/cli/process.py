"""How `nerf` starts and ends.

What lies in the working directory is data: `nerf` may be called in a folder that somebody else made. Python looks for
modules there first when it is started with `-m` or `-c`, as launchers, pools of processes and compilers start it.

At the end nothing that was loaded is taken apart, which takes a second, and nothing is said if the reader left.
"""

import atexit
import os
import select
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from io import TextIOWrapper
from types import FrameType

from nerf_lightning.messages.errors import InputError

FAILED = 1
BAD_INPUT = 2
READER_LEFT = 141
"""128 + SIGPIPE, what a shell says of `yes` too; a sweep takes it for a stop, not for a job that failed."""
STDOUT, STDERR = 1, 2
SETTINGS = {
    ".numba_config.yaml": "numba, whose settings can be given as variables (NUMBA_...)",
    "matplotlibrc": "matplotlib, which also reads ~/.config/matplotlib/matplotlibrc",
}
"""Files that libraries look for in the working directory, and no variable of theirs keeps them from it."""


def main() -> None:
    """Run the command line, and end."""
    with quick_end():
        from nerf_lightning.cli.main import main as answer

        keep_from_subprocesses()
        write_any_name()
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not in a job in the background
            signal.signal(signal.SIGINT, _interrupt)
        sys.unraisablehook = _unraisable
        answer()


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt for the first Ctrl-C; the next one ends the process at once, whatever it waits for."""
    signal.signal(number, signal.SIG_DFL)
    raise KeyboardInterrupt


def _unraisable(unraisable: "sys.UnraisableHookArgs") -> None:
    if unraisable.exc_type is KeyboardInterrupt:  # in a callback of llvmlite, say, which would go on
        signal.raise_signal(signal.SIGINT)
    if unraisable.exc_type is MemoryError:  # in scikit-image's marching cubes, which would go on for ever
        print(
            "nerf: Not enough memory: a library got none. Use a smaller model, picture or resolution.", file=sys.stderr
        )
        os._exit(BAD_INPUT)
    sys.__unraisablehook__(unraisable)


def was_interrupted() -> bool:
    """Return whether there was a Ctrl-C; a library in which it is raised may turn it into an error of its own."""
    return signal.getsignal(signal.SIGINT) is signal.SIG_DFL


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
    # All is written: a further Ctrl-C ends the process at once, instead of as a traceback of what runs at the end.
    if callable(signal.getsignal(signal.SIGINT)):  # not where it is ignored, as in jobs in the background
        signal.signal(signal.SIGINT, signal.SIG_DFL)
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
        try:
            _flush()
        except OSError:
            _silence(STDOUT)
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


def _silence(descriptor: int) -> None:
    """Let what is still buffered go nowhere: Python flushes at its end again, and would complain."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, descriptor)
    os.close(nowhere)


def write_any_name() -> None:
    """Let names that the encoding of a stream lacks be written as Python writes them, here and in subprocesses."""
    encoding = os.environ.get("PYTHONIOENCODING", "").partition(":")[0]
    os.environ["PYTHONIOENCODING"] = f"{encoding}:backslashreplace"
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def keep_from_subprocesses() -> None:
    """Let the Python processes that this one starts, directly or through libraries, import nothing from there."""
    os.environ["PYTHONSAFEPATH"] = "1"
    # A clone that is not installed was found there itself.
    clone = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    if clone not in sys.path:
        sys.path.append(clone)
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), clone]))


def require_no_settings_here() -> None:
    """Refuse to start where a library would obey a file of the working directory."""
    for name, library in SETTINGS.items():
        if os.path.lexists(name):
            raise InputError(
                f"The working directory has a file {name}, which would be read by {library}. Such a file can change "
                "results or run programs. Rename it, or start nerf in another folder."
            )

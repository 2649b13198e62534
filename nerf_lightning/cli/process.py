"""Start the `nerf` process, with no import that can wait, and end it.

Files in the working directory are data: `nerf` may be called in a folder made by someone else. Python searches it for
modules first when started with `-m` or `-c`, as launchers, process pools and compilers do.

At exit, nothing that was loaded is torn down, which would take a second, and nothing is printed if the reader has left.
"""

import atexit
import gc
import importlib
import os
import select
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from io import TextIOWrapper
from types import FrameType, ModuleType
from typing import Any

from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.exit_codes import BAD_INPUT, FAILED, READER_LEFT

SIGNALS = "scipy.signal"
MAY_SET_A_MODE = ("hydra.mode", "hydra/mode", "hydra.searchpath")
"""Settings, after any prefix of Hydra's, that set the mode or name user folders whose files may set it."""
OTHER_FILES = "--config-"  # The prefix of Hydra's options for such folders and files


def announce_start(command: str, arguments: list[str]) -> None:
    """Announce at once on a terminal that a command has started, unless a Hydra option asks for brief output."""
    brief = any(word.startswith("-") and word not in ("-m", "--multirun", "-v", "--verbose") for word in arguments)
    if "torch" not in sys.modules and not brief and sys.stderr is not None and sys.stderr.isatty():
        print(f"starting nerf {command}; loading PyTorch takes a few seconds", file=sys.stderr, flush=True)


@contextmanager
def quick_imports() -> Iterator[None]:
    """Disable the garbage collector during imports: what is imported stays, half a million objects to traverse.

    Later collections skip these objects, too, except at exit: C++ libraries complain about objects that are left then.
    """
    if "lightning" in sys.modules:  # the second job of a sweep: no heavy imports are left, and there may be garbage
        yield
        return
    was_on = gc.isenabled()
    gc.disable()
    try:
        with _signals_later():
            yield
    finally:
        gc.freeze()
        atexit.register(gc.unfreeze)
        if was_on:
            gc.enable()


class _Later(ModuleType):
    """Stand in for a module until an attribute other than `hamming` is accessed."""

    hamming = None

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # inspect reads every module's __file__
            raise AttributeError(name)
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]
        return getattr(importlib.import_module(self.__name__), name)


@contextmanager
def _signals_later() -> Iterator[None]:
    """Defer scipy.signal, an eighth of the import time: torchmetrics only checks that one of its names exists."""
    if SIGNALS in sys.modules:
        yield
        return
    later = sys.modules[SIGNALS] = _Later(SIGNALS)
    try:
        yield
    finally:
        if sys.modules.get(SIGNALS) is later:
            del sys.modules[SIGNALS]


def compose_once() -> None:
    """Make Hydra 1.3 compose a command's config once: it would compose it a first time only to look up `hydra.mode`.

    No YAML in conf/ sets it, so it matters only if files of the user are read. Hydra 1.4 composes once by itself.
    """
    from hydra._internal.hydra import Hydra

    from nerf_lightning.config.hydra_versions import IS_1_3

    composed = Hydra.get_mode
    if not IS_1_3 or composed.__module__ == __name__:
        return

    def get_mode(hydra: Hydra, *args: Any, **kwargs: Any) -> Any:
        may_set_a_mode = any(
            word.startswith(OTHER_FILES) or word.lstrip("+~").startswith(MAY_SET_A_MODE) for word in sys.argv[1:]
        )
        return composed(hydra, *args, **kwargs) if may_set_a_mode else None

    Hydra.get_mode = get_mode  # type: ignore[assignment, method-assign]


STDOUT, STDERR = 1, 2
SETTINGS = {
    ".numba_config.yaml": "numba, whose settings can be given as variables (NUMBA_...)",
    "matplotlibrc": "matplotlib, which also reads ~/.config/matplotlib/matplotlibrc",
}
"""Files that libraries read from the working directory, which no environment variable prevents."""


def main() -> None:
    """Run the command line and exit."""
    with quick_end():
        from nerf_lightning.cli.main import main as answer

        keep_from_subprocesses()
        write_any_name()
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not in a job in the background
            signal.signal(signal.SIGINT, _interrupt)
        sys.unraisablehook = _unraisable
        answer()


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt for the first Ctrl-C; the next one ends the process at once, whatever blocks it."""
    signal.signal(number, signal.SIG_DFL)
    raise KeyboardInterrupt


def _unraisable(unraisable: "sys.UnraisableHookArgs") -> None:
    if unraisable.exc_type is KeyboardInterrupt:  # in a callback of llvmlite, say, which would continue
        signal.raise_signal(signal.SIGINT)
    if unraisable.exc_type is MemoryError:  # in scikit-image's marching cubes, which would continue forever
        print(
            "nerf: Not enough memory: a library got none. Use a smaller model, picture or resolution.", file=sys.stderr
        )
        os._exit(BAD_INPUT)
    sys.__unraisablehook__(unraisable)


def was_interrupted() -> bool:
    """Return whether Ctrl-C was pressed; a library that it interrupts may turn it into an error of its own."""
    return signal.getsignal(signal.SIGINT) is signal.SIG_DFL


@contextmanager
def quick_end() -> Iterator[None]:
    """End this process after the block without tearing down what Python has loaded.

    Threads are joined and exit handlers run, as usual. Python reports uncaught errors and streams that cannot be
    flushed; the process then ends as it would without this.
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
    # All is written: a further Ctrl-C ends the process at once, without a traceback from an exit handler.
    if callable(signal.getsignal(signal.SIGINT)):  # not where it is ignored, as in jobs in the background
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    # As multiprocessing does at the end of its processes.
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
    """Exit silently with READER_LEFT if nothing reads the output any more.

    Raises:
        OSError: the output cannot be written for another reason, such as a full disk.
    """
    try:
        try:
            yield
        except SystemExit:
            _flush()
            raise
        _flush()
    except BrokenPipeError:
        # The pipe may be another one: to a worker, to a film's encoder. That is reported like any error.
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
    # Buffered output would fail at interpreter exit, where nothing can catch the error.
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
    """Discard what is still buffered: Python flushes again at exit and would complain."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, descriptor)
    os.close(nowhere)


def write_any_name() -> None:
    """Write names that a stream cannot encode with backslash escapes, here and in subprocesses."""
    encoding = os.environ.get("PYTHONIOENCODING", "").partition(":")[0]
    os.environ["PYTHONIOENCODING"] = f"{encoding}:backslashreplace"
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def keep_from_subprocesses() -> None:
    """Keep Python processes that this one or its libraries start from importing from the working directory."""
    os.environ["PYTHONSAFEPATH"] = "1"
    # A clone that is not installed was itself found there.
    clone = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    if clone not in sys.path:
        sys.path.append(clone)
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), clone]))


def require_no_settings_here() -> None:
    """Refuse to start if a library would obey a file in the working directory."""
    for name, library in SETTINGS.items():
        if os.path.lexists(name):
            raise InputError(
                f"The working directory has a file {name}, which would be read by {library}. Such a file can change "
                "results or run programs. Rename it, or start nerf in another folder."
            )

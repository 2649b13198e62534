"""Load torch and Lightning in less time: most of what a start takes."""

import atexit
import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager


def announce_start(command: str, arguments: list[str]) -> None:
    """Say at a terminal at once that a command has started, unless an option of Hydra's asks for something brief."""
    brief = any(word.startswith("-") and word not in ("-m", "--multirun", "-v", "--verbose") for word in arguments)
    if "torch" not in sys.modules and not brief and sys.stderr is not None and sys.stderr.isatty():
        print(f"nerf {command} starts; loading PyTorch takes a few seconds", file=sys.stderr, flush=True)


@contextmanager
def quick_imports() -> Iterator[None]:
    """Let the collector of cycles rest during imports: what is imported stays, half a million objects to walk through.

    Later it passes them over, too, but for the end of the process: libraries in C++ complain of what is left then.
    """
    if "lightning" in sys.modules:  # the second job of a sweep: nothing heavy is left, and there may be work to collect
        yield
        return
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        atexit.register(gc.unfreeze)
        if was_on:
            gc.enable()

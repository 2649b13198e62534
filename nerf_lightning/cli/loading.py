"""Start faster: import without garbage collection and without scipy.signal, and compose the config once.

Each saves a quarter of a second or more; `process.py` saves another second at the end.
"""

import atexit
import gc
import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

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

    def get_mode(hydra: Hydra, *given: Any, **named: Any) -> Any:
        may_set_a_mode = any(
            word.startswith(OTHER_FILES) or word.lstrip("+~").startswith(MAY_SET_A_MODE) for word in sys.argv[1:]
        )
        return composed(hydra, *given, **named) if may_set_a_mode else None

    Hydra.get_mode = get_mode  # type: ignore[assignment, method-assign]

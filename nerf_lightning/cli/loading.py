"""Start in less time: imports without the collector of cycles and without scipy.signal, and one composition.

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
"""Settings, after any sign of Hydra's, that set the mode or name folders of the user's whose files may."""
OTHER_FILES = "--config-"  # How Hydra's options for such folders and files begin


def announce_start(command: str, arguments: list[str]) -> None:
    """Say at a terminal at once that a command has started, unless an option of Hydra's asks for something brief."""
    brief = any(word.startswith("-") and word not in ("-m", "--multirun", "-v", "--verbose") for word in arguments)
    if "torch" not in sys.modules and not brief and sys.stderr is not None and sys.stderr.isatty():
        print(f"starting nerf {command}; loading PyTorch takes a few seconds", file=sys.stderr, flush=True)


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
        with _signals_later():
            yield
    finally:
        gc.freeze()
        atexit.register(gc.unfreeze)
        if was_on:
            gc.enable()


class _Later(ModuleType):
    """Stands for a module until something other than `hamming` is asked of it."""

    hamming = None

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # inspect looks at every module's __file__
            raise AttributeError(name)
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]
        return getattr(importlib.import_module(self.__name__), name)


@contextmanager
def _signals_later() -> Iterator[None]:
    """Leave out scipy.signal, an eighth of all: torchmetrics only looks whether a name of its is there."""
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
    """Let Hydra 1.3 compose a command's config once: it would compose it a first time only to look for `hydra.mode`.

    No yaml in conf/ sets one, so it matters only where files of the user are read. Hydra 1.4 does so by itself.
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

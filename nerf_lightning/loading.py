"""Load torch and Lightning in less time: most of what a start takes."""

import atexit
import gc
import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from types import ModuleType
from typing import Any


@contextmanager
def quick_imports() -> Iterator[None]:
    """Import torch and what follows it without a break, and without what nobody will use."""
    if "lightning" in sys.modules:  # the second job of a sweep: nothing heavy is left, and there may be work to collect
        yield
        return
    with _no_collection(), _no_signal_processing():
        yield


@contextmanager
def _no_collection() -> Iterator[None]:
    """Let the collector of cycles rest: what is imported stays, half a million objects, and it would walk through them.

    Later it passes them over, too, but for the end of the process: libraries in C++ complain of what is left then.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        atexit.register(gc.unfreeze)
        if was_on:
            gc.enable()


@contextmanager
def _no_signal_processing() -> Iterator[None]:
    """Let a stand-in for scipy.signal be found, which takes as long to import as torch does.

    Where scipy is installed, torchmetrics imports it (and Lightning torchmetrics) to give it back a name that it once
    had, `hamming`; the stand-in has it. Whatever else may be asked of it is answered by scipy.signal itself.
    """
    if "scipy.signal" in sys.modules or find_spec("scipy") is None:
        yield
        return
    stand_in = sys.modules["scipy.signal"] = _StandIn("scipy.signal")
    try:
        yield
    finally:
        stand_in.step_aside()


class _StandIn(ModuleType):
    hamming = None

    def __getattr__(self, name: str) -> Any:
        # Whoever looks through all modules (inspect does) asks for names like __file__, and wants nothing.
        if name.startswith("__") and name != "__path__":
            raise AttributeError(name)
        self.step_aside()
        return getattr(importlib.import_module(self.__name__), name)

    def step_aside(self) -> None:
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]

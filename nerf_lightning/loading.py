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
    with _no_collection(), _no_plotting():
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
def _no_plotting() -> Iterator[None]:
    """Let torchmetrics, which Lightning imports, find stand-ins for what takes as long to import as torch does.

    It wants scipy.signal, where there is one, to give it back a name that it once had, and matplotlib for the types of
    what its own plots return. Whatever else is asked of a stand-in is answered by the module itself, then and later.
    """
    wanted = [stand_in for stand_in in _stand_ins() if find_spec(stand_in.__name__.partition(".")[0]) is not None]
    if any(stand_in.__name__ in sys.modules for stand_in in wanted):
        yield
        return
    sys.modules.update({stand_in.__name__: stand_in for stand_in in wanted})
    try:
        yield
    finally:
        step_aside()
        for stand_in in wanted:
            stand_in.forget()


def _stand_ins() -> list["StandIn"]:
    axes, colors = StandIn("matplotlib.axes", Axes=object), StandIn("matplotlib.colors", Colormap=object)
    pyplot = StandIn("matplotlib.pyplot", Figure=object, style=StandIn("matplotlib.style", context=_style))
    matplotlib = StandIn("matplotlib", axes=axes, colors=colors, pyplot=pyplot)
    return [matplotlib, axes, pyplot, StandIn("scipy.signal", hamming=None)]


@contextmanager
def _style(*given: Any) -> Iterator[None]:
    with importlib.import_module("matplotlib.style").context(*given):
        yield


class StandIn(ModuleType):
    """A module that is imported when something is asked of it that is not known without.

    Args:
        name: the module's.
        known: what needs no import, until `forget` is called.
    """

    def __init__(self, name: str, **known: Any):
        super().__init__(name)
        self._known = tuple(known)
        self.__dict__.update(known)

    def __getattr__(self, name: str) -> Any:
        """Ask the module itself."""
        # Whoever looks through all modules (inspect does) asks for names like __file__, and wants nothing.
        if name.startswith("__") and name != "__path__":
            raise AttributeError(name)
        step_aside()
        return getattr(importlib.import_module(self.__name__), name)

    def forget(self) -> None:
        """Leave all answers to the module."""
        for name in self._known:
            self.__dict__.pop(name, None)


def step_aside() -> None:
    """Let imports find the modules themselves."""
    for name in [name for name, module in sys.modules.items() if isinstance(module, StandIn)]:
        del sys.modules[name]

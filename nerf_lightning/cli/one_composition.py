"""Let Hydra compose a command's config once: it would compose it a first time only to look for `hydra.mode`."""

import sys
from typing import Any

MAY_SET_A_MODE = ("hydra.mode", "hydra/mode", "hydra.searchpath")
"""Settings, after any sign of Hydra's, that set the mode or name folders of the user's whose files may."""
OTHER_FILES = "--config-"
"""How Hydra's options for such folders and files begin."""


def compose_once() -> None:
    """Take the mode from the command line where no file but ours is read: no yaml in conf/ sets one."""
    from hydra._internal.hydra import Hydra

    composed = Hydra.get_mode
    if composed.__module__ == __name__:
        return

    def get_mode(hydra: Hydra, *given: Any, **named: Any) -> Any:
        return composed(hydra, *given, **named) if any(map(_may_set_a_mode, sys.argv[1:])) else None

    Hydra.get_mode = get_mode  # type: ignore[assignment, method-assign]


def _may_set_a_mode(argument: str) -> bool:
    return argument.startswith(OTHER_FILES) or argument.lstrip("+~").startswith(MAY_SET_A_MODE)

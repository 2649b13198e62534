"""One interface to Hydra 1.3 and 1.4, and a fix of 1.3 for Python 3.14."""

import argparse
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import hydra
from hydra import utils
from hydra._internal import utils as internals
from hydra.errors import HydraException, InstantiationException
from omegaconf import OmegaConf

IS_1_3 = hydra.__version__.startswith("1.3.")
DEFAULTS = {"version_base": "1.3"} if IS_1_3 else {}
"""Arguments of `hydra.main` and `initialize_config_dir`: no backward compatibility with older versions of Hydra."""
SWEEPS_REMOVE = not hydra.__version__.startswith("1.4.0rc")
"""Whether a sweep can remove settings; release candidates of 1.4 pass `~key` to its jobs as `~key=null`."""


def instantiate(node: Any, trusted: Sequence[str] | None = None) -> Any:
    """Build the classes that a config names, nested ones first.

    Args:
        node: the config, or a part of it.
        trusted: what may be built of a config from a file: names of classes, or of everything below a module
            (`module.*`). Hydra 1.3 ignores it, so callers check, too. None: the user's own config may name anything.
    """
    if IS_1_3:
        return utils.instantiate(node, _convert_="all")
    allowed = _anything() if trusted is None else vars(utils)["execution_whitelist"](trusted, reset=True)
    try:
        return utils.instantiate(node, _convert_="all", _execution_whitelist_=allowed)
    except Exception as error:
        # 1.4 passes a constructor's errors on, with a note of where it is named; 1.3 turns them into Hydra errors.
        where = next((note for note in getattr(error, "__notes__", ()) if note.startswith("full_key: ")), None)
        if where is None or isinstance(error, HydraException):
            raise
        raise InstantiationException(f"{error!r}\n{where}") from error


def hydra_main(**arguments: Any) -> Any:
    """Return Hydra's decorator for a command, whose config is the user's own: its callbacks may be of any class."""
    own = {} if IS_1_3 else {"execution_whitelist": _anything()}
    return hydra.main(**arguments, **DEFAULTS, **own)


def _anything() -> Any:
    return vars(utils)["UNSAFE_DISABLE_EXECUTION_CHECKS"]


def register_resolver(name: str, resolver: Callable[..., Any]) -> None:
    """Let configs call a function with `${name:...}`."""
    register: Any = OmegaConf.register_new_resolver if IS_1_3 else OmegaConf.register_resolver
    register(name, resolver, replace=True)


class _Parser(argparse.ArgumentParser):
    def _check_help(self, action: argparse.Action) -> None:
        if isinstance(action.help, str):
            checked: Any = super()
            checked._check_help(action)


def options_parser() -> argparse.ArgumentParser:
    """Return the parser of Hydra's own options, and let Hydra create others.

    Python 3.14's parsers check each help text at once, and Hydra 1.3 has one that is not a string. 1.4 has none.
    """
    if IS_1_3:
        internals.argparse = SimpleNamespace(**vars(argparse) | {"ArgumentParser": _Parser})  # type: ignore[assignment]
    return internals.get_args_parser()

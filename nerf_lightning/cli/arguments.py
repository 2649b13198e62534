"""Hydra's own options (`--cfg job`, `--config-dir DIR`), told from overrides by Hydra's own parser."""

from collections.abc import Sequence
from typing import NoReturn

from hydra._internal.utils import get_args_parser

from nerf_lightning.errors import InputError
from nerf_lightning.manual.suggestions import did_you_mean

COMMON = ("--help", "--version", "--verbose", "--multirun", "--cfg", "--resolve", "--config-dir", "--hydra-help")


def options_first(arguments: Sequence[str]) -> list[str]:
    """Return Hydra's options, each as one word, and after them the overrides, wherever they were typed.

    Raises:
        InputError: an option is unknown, or has no value or a wrong one.

    >>> options_first(["seed=1", "--cfg", "job", "model=nerf", "-m"])
    ['--cfg=job', '--multirun', 'seed=1', 'model=nerf']
    """
    parser = get_args_parser()
    parser.error = _refuse  # type: ignore[method-assign]
    unasked = vars(parser.parse_args([]))
    asked = vars(parser.parse_intermixed_args(arguments))
    overrides: list[str] = asked.pop("overrides")
    options = [_as_word(name, value) for name, value in asked.items() if value != unasked[name]]
    return [*options, *overrides]


def _as_word(name: str, value: str | bool) -> str:
    option = f"--{name.replace('_', '-')}"
    return option if value is True else f"{option}={value}"


def _refuse(message: str) -> NoReturn:
    option = next((word for word in message.split() if word.startswith("--")), "")
    hint = did_you_mean(option, COMMON)
    raise InputError(f"{message}.{hint} nerf COMMAND --hydra-help lists the options; settings are given as key=value.")

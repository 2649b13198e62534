"""Values as written on the command line, for Hydra and for the shell."""

import os
import re
import shlex
from collections.abc import Iterable
from typing import Any

from hydra.core.override_parser.types import Quote, QuotedString
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.files.folders import option_names

# What Hydra accepts without quotes in any position.
SWITCH: dict[object, bool] = {"on": True, True: True, "off": False, False: False, None: False}
"""What the values of a switch mean."""
PLAIN = re.compile(r"[\w./:@%+-]+", re.ASCII)
OPEN_SECTIONS = re.compile(rf"(trainer\.lightning|final\.({'|'.join(option_names('what'))}))[.=]")
"""Sections that accept keys which our YAML files do not list: Lightning's arguments, and exporters by name."""


def quoted(value: Any) -> str:
    """Return a plain value, a path or a list of them in a form that Hydra reads back.

    >>> quoted("it's"), quoted(None), quoted([True, 2])
    ("'it\\\\'s'", 'null', '[true,2]')
    """
    if value is None:
        return "null"
    if isinstance(value, list | tuple):
        return f"[{','.join(map(quoted, value))}]"
    if isinstance(value, os.PathLike):
        value = os.fspath(value)
    if isinstance(value, str):
        # OmegaConf reads ${ as an interpolation, and backslashes before it as escapes; elsewhere they are literal.
        text = re.sub(r"(\\*)\$\{", r"\1\1\\${", value)
        return QuotedString(text=text, quote=Quote.single).with_quotes()
    return str(value).lower() if isinstance(value, bool) else str(value)


def to_type(key: str, text: str) -> str:
    """Return an override as typed in a shell, with quotes where the shell or Hydra needs them.

    >>> to_type("scene.root", "data/fox")
    'scene.root=data/fox'
    >>> to_type("scene.root", "my fox (1)")
    '"scene.root=\\'my fox (1)\\'"'
    """
    override = f"{key}={text if PLAIN.fullmatch(text) else quoted(text)}"
    # If it contains single quotes, enclosing double ones are easier to read than the output of shlex.
    if "'" in override and not re.search(r'["$`\\!]', override):
        return f'"{override}"'
    return shlex.quote(override)


def key_of(override: str) -> str:
    """Return the key that an override sets, adds or removes.

    >>> key_of("++trainer.lightning.profiler=simple"), key_of("~callbacks.film")
    ('trainer.lightning.profiler', 'callbacks.film')
    """
    return override.lstrip("+~").partition("=")[0]


def open_sections(overrides: Iterable[str]) -> list[str]:
    """Return overrides that Hydra accepts for sections with unlisted keys, without a + from the user.

    >>> open_sections(["trainer.lightning.profiler=simple", "final.page=true", "seed=1"])
    ['++trainer.lightning.profiler=simple', '++final.page=true', 'seed=1']
    """
    return [f"++{override}" if OPEN_SECTIONS.match(override) else override for override in overrides]


def flatten(config: DictConfig) -> dict[str, object]:
    """Return the leaves of a config by their dotted keys; interpolations stay text.

    >>> flatten(OmegaConf.create({"a": {"b": 1}, "c": [2]}))
    {'a.b': 1, 'c': [2]}
    """
    return leaves(OmegaConf.to_container(config, resolve=False))


def leaves(node: object, path: str = "") -> dict[str, object]:
    """Return the leaves of nested dictionaries by their dotted keys below `path`.

    >>> leaves({"b": 1, "c": {}}, "a")
    {'a.b': 1, 'a.c': {}}
    """
    if not isinstance(node, dict) or not node:
        return {path: node}
    below = (leaves(value, f"{path}.{key}" if path else str(key)) for key, value in node.items())
    return {key: value for part in below for key, value in part.items()}

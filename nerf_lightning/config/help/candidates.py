"""Completions of a partially typed command line: commands, groups, options, settings, values, paths."""

import os
import re
from collections.abc import Iterable, Iterator
from glob import escape, glob

from nerf_lightning.config.help.catalogue import Command, command_named
from nerf_lightning.files.folders import option_names

SHELLS = ("bash", "zsh", "fish")
FLAGS = ("--help", "--multirun", "--cfg", "--config-dir", "--hydra-help")
LITERALS = {"bool": ("true", "false"), "null": ("null",)}


def candidates(words: list[str], commands: Iterable[str]) -> list[str]:
    """Return completions of the last word, which may be empty, as whole words; the first word is a command.

    >>> candidates(["train", "model=nerf_s"], ["train"])
    ['model=nerf_small']
    >>> candidates(["train", "trainer.max_"], ["train"])
    ['trainer.max_epochs=', 'trainer.max_steps=']
    """
    *before, current = words or [""]
    return sorted({word for word in _possible(before, current, list(commands)) if word.startswith(current)})


def _possible(before: list[str], current: str, commands: list[str]) -> Iterable[str]:
    if not before:
        return commands
    if before[0] == "completion":
        return SHELLS
    if before[0] == "help":
        return [*commands, *(word.removesuffix("=") for word in _possible(["train"], current, commands))]
    command = command_named(before[0])
    if command is None:
        return []
    if current.startswith("-"):
        return FLAGS
    if "=" in current:
        return _values(command, *current.split("=", 1))
    return [*_keys(command, current, before), *(_paths(current) if command.path_setting else ())]


def _keys(command: Command, current: str, before: list[str]) -> Iterator[str]:
    """Yield groups, and settings up to their next dot."""
    chosen = dict(word.split("=", 1) for word in before if "=" in word)
    keys = [f"{group}=" for group in command.options if len(option_names(group)) > 1]
    for setting in command.settings:
        group, _, name = setting.source.partition("=")
        if setting.text and setting.is_own and chosen.get(group, name) == name:
            keys.append(f"{setting.key}=")
    for key in keys:
        head, dot, _ = key[len(current) :].partition(".")
        yield key[: len(current)] + head + dot


def _values(command: Command, key: str, typed: str) -> Iterator[str]:
    done, comma, _ = typed.rpartition(",")
    found = option_names(key.lstrip("+")) if key.lstrip("+") in command.options else []
    takes = " ".join(setting.takes for setting in command.settings if setting.key == key.lstrip("+"))
    found += re.findall(r"'([^']*)'", takes)
    found += [value for word, values in LITERALS.items() if word in takes for value in values]
    yield from (f"{key}={done}{comma}{value}" for value in found)
    if not takes or "str" in takes:
        yield from (f"{key}={path}" for path in _paths(typed))


def _paths(typed: str) -> Iterator[str]:
    home, folder = os.path.expanduser("~"), os.path.expanduser(typed)
    for path in glob(escape(folder) + "*"):
        shown = path.replace(home, "~", 1) if typed.startswith("~") else path
        yield shown + "/" * os.path.isdir(path)

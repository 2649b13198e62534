"""What may follow on a command line that somebody is typing: commands, groups, options, settings, values, paths."""

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from nerf_lightning.manual.catalogue import Command, command_named

SHELLS = ("bash", "zsh", "fish")
FLAGS = ("--help", "--multirun", "--cfg", "--config-dir", "--hydra-help")
TAKES_PATHS = ("table", "report")
"""Commands to which a folder may be given without a key."""


def candidates(words: list[str], commands: Iterable[str]) -> list[str]:
    """Return what the last word may become, as whole words.

    Args:
        words: all that stands behind `nerf` up to the cursor; the last one may be empty.
        commands: the names that may come first.

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
    asked = command_named(before[0])
    if asked is None:
        return []
    if current.startswith("-"):
        return FLAGS
    if "=" in current:
        return _values(asked, *current.split("=", 1))
    return [*_keys(asked, current, before), *(_paths(current) if asked.name in TAKES_PATHS else ())]


def _keys(asked: Command, current: str, before: list[str]) -> Iterator[str]:
    """Yield groups and settings, these up to their next dot."""
    listed = {group.name for group in asked.groups}
    for group in (*asked.groups, *(group for group in asked.brought if group.name not in listed)):
        if len(group.options) > 1:
            yield _to_next_dot(f"{group.typed}=", current)
        root = group.place.partition(".")[0]
        if any(not option.file.is_global or root in option.entry.below for option in group.options):
            yield f"{root}."
    yield from (_to_next_dot(f"{each.key}=", current) for each in asked.own if not each.is_section)
    if "." in current:
        chosen = dict(word.split("=", 1) for word in before if "=" in word)
        for option, setting in asked.settings_below(current.partition(".")[0]):
            is_chosen = option is None or chosen.get(option.group, option.name) == option.name
            if is_chosen and not setting.is_section and setting.key.startswith(current):
                yield _to_next_dot(f"{setting.key}=", current)


def _to_next_dot(key: str, current: str) -> str:
    dot = key.find(".", len(current))
    return key if dot < 0 else key[: dot + 1]


def _values(asked: Command, key: str, typed: str) -> Iterator[str]:
    name, (done, comma, _) = key.lstrip("+"), typed.rpartition(",")
    found = [option.name for group in asked.groups + asked.brought if group.typed == name for option in group.options]
    settings = [
        setting
        for _, setting in asked.settings_below(name.partition(".")[0])
        if setting.key == name and not setting.is_section
    ]
    found += [choice for setting in settings for choice in setting.kind.choices]
    yield from (f"{key}={done}{comma}{value}" for value in found)
    if any(not setting.kind.words or "text" in setting.kind.words for setting in settings):
        yield from (f"{key}={path}" for path in _paths(typed))


def _paths(typed: str) -> Iterator[str]:
    folder, slash, name = typed.rpartition("/")
    there = Path(os.path.expanduser(f"{folder}{slash}") or ".")
    try:
        entries = sorted(there.iterdir())
    except OSError:
        return
    for entry in entries:
        if entry.name.startswith(name) and (name.startswith(".") or not entry.name.startswith(".")):
            yield f"{folder}{slash}{entry.name}{'/' if entry.is_dir() else ''}"

"""A catalog of a command: its groups with their options, and all settings, read from conf/ without Hydra."""

import re
from collections.abc import Callable
from functools import cache, cached_property
from typing import NamedTuple

from nerf_lightning.config.help.docstrings import Constructor, constructor
from nerf_lightning.config.help.yaml_comments import CommentedYaml, Entry, read_commented
from nerf_lightning.files.folders import conf_file, option_names

OF_SWEEPS = ("hydra/launcher", "hydra/sweeper")
"""Groups of Hydra to which conf/ adds options: any command may be swept with -m."""
PATH_SETTINGS = ("ckpt", "run", "runs")
REQUIRED = "(required)"
"""Placeholder for the value of a setting that the user must provide."""
TAKES = {"bool": "bool", "int": "int", "float": "float", "seq": "list"}


class Setting(NamedTuple):
    """One setting of a YAML, or a section of settings."""

    key: str
    text: str
    """The value as written in the YAML; empty for a section."""
    takes: str
    """The type of its values."""
    meaning: str
    """The sentence of the docstring, and that of the comment next to it."""
    source: str
    """Its YAML: an option such as `scene=colmap`, or the command."""
    is_own: bool
    """Whether it belongs to that group or command, which may also set settings of others."""


class Option(NamedTuple):
    """One YAML of a group."""

    typed: str
    """How it is chosen, such as `scene=colmap`."""
    about: str
    """The comment at the top of its YAML; without one, the docstring of what it builds."""
    is_global: bool
    settings: list[Setting]
    """Its own settings, those of its base options, and those of the options that it chooses for its parts."""
    chosen: dict[str, str]
    """The options that it chooses in other groups."""


class Command:
    """Groups and settings of one command. A group is named as typed: `sampler@model.levels.fine.sampler`."""

    def __init__(self, name: str, file: CommentedYaml):
        self.name = name
        self.template = file.entries["hydra.help.template"].text
        self.groups = {
            group: name if name in option_names(group.partition("@")[0]) else None
            for group, name in file.defaults
            if group not in ("_self_", "hydra")
        }
        """With the option of the command's defaults list, in its order."""
        sections = {section_of(group) for group in self.groups}
        own = {key: entry for key, entry in file.entries.items() if root(key) != "hydra"}
        self.written = _settings(own, f"nerf {name}", lambda key: root(key) not in sections)
        """The settings of its own YAML."""

    @property
    def path_setting(self) -> str | None:
        """The setting that takes paths which are typed without a key; None: this command takes none."""
        return next((setting.key for setting in self.written if setting.key in PATH_SETTINGS), None)

    @cached_property
    def options(self) -> dict[str, list[Option]]:
        """The options by group: its own groups, then those that options have for parts, such as a level's sampler."""
        own = {group: options(group) for group in self.groups}
        parts = [part for each in own.values() for one in each for part in one.chosen if "@" in part]
        return own | {group: options(group) for group in (*parts, *OF_SWEEPS)}

    @cached_property
    def settings(self) -> list[Setting]:
        """Every setting of its YAML and of all options."""
        every = (option for options in self.options.values() for option in options)
        return [*self.written, *(setting for option in every for setting in option.settings)]

    @cached_property
    def chosen(self) -> dict[str, Option]:
        """The options chosen by default."""
        names, found = dict(self.groups), dict[str, Option]()
        for _ in names:  # a chosen option may choose others
            found = {group: read_option(group, name) for group, name in names.items() if name}
            names |= {group: name for each in found.values() for group, name in each.chosen.items() if group in names}
        return found

    def default(self, key: str) -> str:
        """Return the default value of a setting; if only unchosen options have it, the first one's."""
        in_order = sorted(self.chosen.values(), key=lambda each: not each.is_global)
        candidates = (*self.written, *(setting for each in in_order for setting in each.settings), *self.settings)
        return next(each.text for each in candidates if each.key == key)


@cache
def command_named(name: str) -> Command | None:
    """Return a command's catalog; None if there is no such command."""
    file = conf_file(name)
    return Command(name, read_commented(file)) if file.is_file() else None


def known_names(command: Command) -> list[str]:
    """Return a command's groups and settings, each once."""
    return list(dict.fromkeys([*command.groups, *(setting.key for setting in command.settings)]))


def section_of(group: str) -> str:
    """Return the section that a group fills."""
    name, _, package = group.partition("@")
    return package or name.replace("/", ".")


def root(key: str) -> str:
    """Return the first word of a dotted key."""
    return key.partition(".")[0]


def options(group: str) -> list[Option]:
    """Return a group's options."""
    return [read_option(group, name) for name in option_names(group)]


@cache
def read_option(group: str, name: str) -> Option:
    """Read one option of a group."""
    folder, typed, section = group.partition("@")[0], f"{group}={name}", section_of(group)
    file = read_commented(conf_file(f"{folder}/{name}"))
    entries, chosen = _merged(file, folder, "" if file.is_global else f"{section}.")
    settings = _settings(entries, typed, lambda key: root(key) == root(section))
    maker = _maker(entries, section)
    about = file.header or (maker.summary if maker else "")
    parts = (read_option(part, name) for part, name in chosen.items() if "@" in part)
    return Option(typed, about, file.is_global, settings + [each for part in parts for each in part.settings], chosen)


def _merged(file: CommentedYaml, folder: str, prefix: str) -> tuple[dict[str, Entry], dict[str, str]]:
    """Merge a YAML over its base options, and collect what all of them choose."""
    entries, chosen = dict[str, Entry](), dict[str, str]()
    for typed, name in file.defaults:
        group, at, package = typed.removeprefix("override ").removeprefix("/").partition("@")
        base = conf_file(group if "/" in typed else f"{folder}/{group}")
        if name is not None:
            chosen[f"{group}@{prefix}{package}" if at else group] = name
        elif base.is_file():
            theirs, also = _merged(read_commented(base), folder, prefix)
            entries, chosen = entries | theirs, chosen | also
    for key, (text, kind, comment) in file.entries.items():
        base_entry = entries.get(prefix + key)
        entries[prefix + key] = Entry(text, kind, comment or (base_entry.comment if base_entry else ""))
    return entries, chosen


def _maker(entries: dict[str, Entry], section: str) -> Constructor | None:
    target = entries.get(f"{section}._target_")
    return None if target is None else constructor(target.text)


def _settings(entries: dict[str, Entry], source: str, is_own: Callable[[str], bool]) -> list[Setting]:
    found: dict[str, Setting] = {}
    for key, entry in entries.items():
        section, _, name = key.rpartition(".")
        maker, parent = _maker(entries, section), found.get(section)
        argument = maker.arguments.get(name) if maker else None
        built = _maker(entries, key)
        documented = argument.meaning if argument else built.summary if built else ""
        # A table that is one argument, such as scene.download: its sentence applies to all its entries.
        texts = [documented, entry.comment] if documented or entry.comment or maker or not parent else [parent.meaning]
        takes = argument.takes if argument else TAKES.get(entry.type, "")
        meaning = " ".join(sentence(text, takes) for text in texts if text)
        if not name.startswith("_"):
            found[key] = Setting(key, entry.text.replace("???", REQUIRED), takes, meaning, source, is_own(key))
    return list(found.values())


def sentence(text: str, takes: str = "") -> str:
    """Return a phrase as a sentence; a literal value at its beginning is unchanged.

    >>> sentence("most views; None: all"), sentence("auto takes a GPU", "'auto' | null")
    ('Most views; null: all.', 'auto takes a GPU.')
    """
    text = re.sub(r"\bNone\b", "null", text.replace("`", "")).strip()
    first = text.split(maxsplit=1)[0].rstrip(":,;")
    is_value = f"'{first}'" in takes or "_" in first or first == "null"
    return (text if is_value else text[0].upper() + text[1:]) + ("" if text.endswith((".", "!", "?", ":")) else ".")

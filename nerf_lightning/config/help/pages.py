"""Pages of `nerf help`: a command, a group, one of its options, a section of settings, or one setting.

Which settings and groups a command's page lists: `hydra.help.template` in its YAML.
"""

import re
from collections.abc import Iterator
from textwrap import fill

from nerf_lightning.config.help.catalogue import Command, Option, Setting
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.suggestions import did_you_mean

COLUMN = 34  # Start of the sentences in a list
PLACEHOLDER = re.compile(r"^\$(GROUPS|SETTINGS):(.*)$", re.MULTILINE)
END = re.compile(r"(?<=\.)\s+(?=[A-Z`*-]|$)|;\s")


def command_page(command: Command, width: int) -> str:
    """Return the short help of a command: the template in its YAML, with its lists filled in.

    `$SETTINGS: KEY ...` becomes a line for each key; `$GROUPS: NAME ...` its groups, with a line per option.
    """

    def listed(match: re.Match[str]) -> str:
        kind, names = match[1], match[2].split()
        if kind == "GROUPS":
            return "\n".join(_groups(command, names, width))
        meanings = {each.key: brief(each.meaning) for each in reversed(command.settings) if each.is_own}
        return "\n".join(row(f"{key}={command.default(key)}", meanings[key], width) for key in names)

    return PLACEHOLDER.sub(listed, command.template).rstrip()


def page_of(command: Command, word: str, width: int) -> str | None:
    """Return the full text of a group, an option, a section or a setting; None if the command has no such thing."""
    name, _, value = word.lstrip("+~").partition("=")
    for group in (each for each in command.options if name in (each, each.partition("@")[0])):
        options = {option.typed.partition("=")[2]: option for option in command.options[group]}
        if value in options:
            return _option_page(options[value], width)
        if value:
            raise InputError(f"There is no {word}.{did_you_mean(value, options, f'{name}=')}")
        if len(options) > 1:
            rows = [row(key, brief(option.about), width) for key, option in options.items()]
            return "\n".join([f"{group}=OPTION", "", *rows, "", f"nerf help {group}=OPTION lists the settings of one."])
    below = [each for each in command.settings if f"{each.key}.".startswith(f"{name}.")]
    about = [_described(each, width) for each in below if each.key == name and not each.text][:1]
    keys = dict.fromkeys(each.key for each in below if each.text)
    return "\n\n".join([*about, *(_setting_page(command, key, width) for key in keys)]) or None


def brief(text: str) -> str:
    """Return the first sentence of a text, up to its semicolon, for a list.

    >>> brief("Shrink by 2.5 and more; else not. Others are refused.")
    'Shrink by 2.5 and more'
    """
    return END.split(text.replace("`", "").strip(), maxsplit=1)[0].removesuffix(".")


def _groups(command: Command, in_full: list[str], width: int) -> Iterator[str]:
    for group in sorted(command.groups, key=lambda group: group not in in_full):
        options = command.options[group]
        chosen = command.chosen.get(group)
        default = chosen.typed.partition("=")[2] if chosen else "the run's" if group == "scene" else ""
        default = f" (default {default})" if default else ""
        if group in in_full:
            yield f"  {group}{default}"
            yield from (row(f"  {option.typed}", brief(option.about), width) for option in options)
        elif len(options) > 1:
            yield row(group, ", ".join(option.typed.partition("=")[2] for option in options) + default, width)


def _option_page(option: Option, width: int) -> str:
    chosen = [f"{group}={name}" for group, name in option.chosen.items()]
    of_others = [f"{each.key}={each.text}" for each in option.settings if each.text and not each.is_own]
    lists = [f"{word} {', '.join(what)}" for word, what in (("Chooses", chosen), ("Sets", of_others)) if what]
    own = [_described(each, width) for each in option.settings if each.text and each.is_own]
    return "\n\n".join([option.typed, *(_paragraph(text, width, 2) for text in [option.about, *lists]), *own])


def _setting_page(command: Command, key: str, width: int) -> str:
    """Return all that is known about a setting; if its meaning differs between options, each meaning."""
    every, default = [each for each in command.settings if each.key == key], command.default(key)
    alike: dict[tuple[str, str], list[Setting]] = {}
    for each in [each for each in every if each.is_own] or every:
        alike.setdefault((each.meaning, each.takes), []).append(each)
    lines = [f"{key}={default}"]
    for settings in alike.values():
        if len(alike) > 1:
            lines.append(_paragraph(f"With {', '.join(each.source for each in settings)}:", width, 2))
        lines += _described(settings[0], width).splitlines()[1:]
    values = [f"{each.source} {each.text}" for each in every if each.text != default]
    return "\n".join([*lines, *([_paragraph(f"Set by {', '.join(values)}", width, 4)] if values else [])])


def _described(setting: Setting, width: int) -> str:
    lines = [f"{setting.key}={setting.text}" if setting.text else setting.key, _paragraph(setting.meaning, width, 4)]
    return "\n".join([*lines, *([_paragraph(f"Takes {setting.takes}", width, 4)] if setting.takes else [])])


def row(name: str, meaning: str, width: int) -> str:
    """Return a line of a list: a name and, from a fixed column on, its meaning."""
    start, indent = f"  {name:<{COLUMN - 3}} ", " " * COLUMN
    if len(start) > COLUMN:
        return f"{start.rstrip()}\n{fill(meaning, width, initial_indent=indent, subsequent_indent=indent)}"
    return fill(meaning, width, initial_indent=start, subsequent_indent=indent, break_long_words=False)


def _paragraph(text: str, width: int, indent: int) -> str:
    ended = text if text.endswith((".", ":")) else f"{text}."
    return fill(ended, width, initial_indent=" " * indent, subsequent_indent=" " * indent, break_long_words=False)

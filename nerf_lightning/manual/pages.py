"""What `nerf help` prints: a command, a group, one option of it, a section of settings, or one setting."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from textwrap import fill

from nerf_lightning.errors import InputError
from nerf_lightning.manual.catalogue import Command, Group, Option
from nerf_lightning.manual.commented_yaml import brief
from nerf_lightning.manual.settings import Setting, maker_of
from nerf_lightning.manual.suggestions import did_you_mean

COLUMN = 34
"""Where the sentences of a list begin."""
PLACEHOLDER = re.compile(r"^\$(GROUPS|SETTINGS)\b:?(.*)$", re.MULTILINE)


def command_page(command: Command, width: int) -> str:
    """Return the short help of a command: the template in its yaml, with its lists filled in.

    `$SETTINGS: KEY ...` becomes a line for each key; `$GROUPS: NAME ...` its groups, these with a line per option.
    """

    def listed(found: re.Match[str]) -> str:
        names = found[2].split()
        return "\n".join(
            _setting_lines(command, names, width) if found[1] == "SETTINGS" else _groups(command, names, width)
        )

    return PLACEHOLDER.sub(listed, template(command)).rstrip()


def template(command: Command) -> str:
    """Return what the yaml of a command says of it, with the places of its lists."""
    return str(command.file.root.below["hydra"].below["help"].below["template"].value)


def page_of(command: Command, word: str, width: int) -> str | None:
    """Return the full text of a group, an option, a section or a setting; None where the command has no such thing."""
    name, _, value = word.lstrip("+~").partition("=")
    groups = [group for group in (*command.groups, *command.brought) if name in (group.typed, group.name)]
    for group in groups:
        option = next((each for each in group.options if each.name == value), None)
        if option is not None:
            return _option_page(group, option, width)
        if value:
            raise InputError(
                f"There is no {word}.{did_you_mean(value, [each.name for each in group.options], f'{name}=')}"
            )
    below = [pair for pair in command.settings if pair[1].key == name or pair[1].key.startswith(f"{name}.")]
    if groups and len(groups[0].options) > 1:
        return _group_page(groups[0], width)
    about = [_described(setting, width) for _, setting in below if setting.key == name and setting.is_section][:1]
    keys = dict.fromkeys(setting.key for _, setting in below if not setting.is_section)
    return "\n\n".join([*about, *(_setting_page(command, key, width) for key in keys)]) or None


def _setting_lines(command: Command, keys: Iterable[str], width: int) -> Iterator[str]:
    known: dict[str, Setting] = {}
    for _, setting in command.settings:
        known.setdefault(setting.key, setting)
    for key in keys:
        yield _row(f"{key}={command.default(key)}", brief(said(known[key])), width)


def _groups(command: Command, in_full: list[str], width: int) -> Iterator[str]:
    chosen = [group for group in command.groups if len(group.options) > 1 or group.name in in_full]
    for group in sorted(chosen, key=lambda group: group.name not in in_full):
        default = f" (default {command.chosen[group.typed].name})" if group.typed in command.chosen else ""
        if group.name in in_full and group.typed == group.name:
            yield f"  {group.typed}{default}"
            yield from (_row(f"  {group.typed}={option.name}", option.summary, width) for option in group.options)
        else:
            yield _row(group.typed, ", ".join(option.name for option in group.options) + default, width)


def _row(left: str, right: str, width: int) -> str:
    start = f"  {left:<{COLUMN - 3}} "
    if len(start) > COLUMN:
        return f"{start}\n{fill(right, width, initial_indent=' ' * COLUMN, subsequent_indent=' ' * COLUMN)}"
    return fill(right, width, initial_indent=start, subsequent_indent=" " * COLUMN, break_long_words=False)


def _group_page(group: Group, width: int) -> str:
    default = f"; {group.chosen} where nothing is said" if group.chosen else ""
    lines = [f"{group.typed}=OPTION{default}", ""]
    lines += [_row(option.name, option.summary, width) for option in group.options]
    return "\n".join([*lines, "", f"nerf help {group.typed}=OPTION lists the settings of one."])


def _option_page(group: Group, option: Option, width: int) -> str:
    maker = maker_of(option.entry)
    parts = [f"{group.typed}={option.name}", _paragraph(option.file.header or option.summary, width, 2)]
    if maker is not None and option.file.header:
        parts.append(_paragraph(maker.summary, width, 2))
    settings = [each for each in option.settings if not each.is_section]
    chosen = [f"{place}={name}" for place, name in option.chosen.items()]
    of_others = [f"{each.key}={each.text}" for each in settings if not each.meaning]
    parts += [
        _paragraph(f"{word} {', '.join(what)}", width, 2)
        for word, what in (("Chooses", chosen), ("Sets", of_others))
        if what
    ]
    return "\n\n".join([*parts, *(_described(each, width) for each in settings if each.meaning)])


def _setting_page(command: Command, key: str, width: int) -> str:
    """Return all that is known of a setting; where options mean different things by it, each."""
    alike: dict[tuple[str, str, str], list[tuple[Option | None, Setting]]] = {}
    for option, setting in command.settings:
        if setting.key == key:
            alike.setdefault((setting.meaning, setting.kind.words, setting.bounds), []).append((option, setting))
    set_by = command.assignments(key)
    pages = []
    for pairs in alike.values():
        values = dict.fromkeys(setting.text for _, setting in pairs)
        several = len(alike) > 1 or len(values) > 1
        shown = next(iter(values)) if len(alike) > 1 else command.default(key)
        having = [f"{each.group}={each.name} {setting.text}" for each, setting in pairs if each is not None and several]
        pages.append(_described(replace(pairs[0][1], text=shown), width) + _list("With", having, width))
    setting_it = [f"{who} to {text}" for who, text in set_by]
    return "\n\n".join(pages) + _list("Set by", setting_it, width)


def _list(word: str, items: list[str], width: int) -> str:
    return f"\n{_paragraph(' '.join((word, ', '.join(items))), width, 4)}" if items else ""


def _described(setting: Setting, width: int) -> str:
    name = setting.key if setting.is_section else f"{setting.key}={setting.text}"
    lines = [name, _paragraph(said(setting), width, 4)]
    if setting.note:
        lines.append(_paragraph(sentence(setting.note), width, 4))
    if setting.kind.words:
        lines.append(
            _paragraph(f"Takes {setting.kind.words}{f': {setting.bounds}' if setting.bounds else ''}", width, 4)
        )
    return "\n".join(lines)


def said(setting: Setting) -> str:
    """Return what a setting means, as a sentence."""
    return sentence(setting.meaning, (*setting.kind.choices, setting.text))


def sentence(text: str, values: Iterable[str] = ()) -> str:
    """Return a phrase of a docstring as a person reads it; the name of a value at its beginning stays small.

    >>> sentence("most views; None: all"), sentence("auto takes a GPU", ["auto"])
    ('Most views; null: all.', 'auto takes a GPU.')
    """
    text = re.sub(r"\bNone\b", "null", text.replace("`", "")).strip()
    first = re.match(r"[\w-]*", text)
    is_value = first is None or first[0] in values or "_" in first[0] or first[0] == "null"
    return (text if is_value else text[:1].upper() + text[1:]) + ("" if text.endswith((".", "!", "?")) else ".")


def _paragraph(text: str, width: int, indent: int) -> str:
    ended = text if text.endswith((".", ":")) else f"{text}."
    return fill(ended, width, initial_indent=" " * indent, subsequent_indent=" " * indent, break_long_words=False)

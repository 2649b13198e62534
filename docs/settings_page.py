"""The page of all settings, written when Sphinx builds the documentation, from what `nerf help` reads."""

from collections.abc import Iterable, Iterator
from pathlib import Path

from nerf_lightning.cli.main import find_commands
from nerf_lightning.config.help.catalogue import Command, Setting, command_named
from nerf_lightning.config.help.pages import brief

HEAD = """# Settings

Generated from docstrings and YAML files; `nerf help NAME` prints the same for one setting, group or option. A setting
is given as `name=value`, an option of a group as `group=option`.
"""


def write(folder: Path) -> None:
    """Write `settings.md`: each command with its own settings, each group where it first comes up."""
    lines, told = [HEAD], set[str]()
    for name in sorted(find_commands(), key=lambda name: name != "train"):
        command = command_named(name)
        assert command is not None
        lines += [f"## nerf {name}", "", *_table(command.written)]
        for group in command.groups:
            if group not in told:
                told.add(group)
                lines += _of_group(command, group)
    (folder / "settings.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _of_group(command: Command, group: str) -> Iterator[str]:
    default, options = command.chosen.get(group), command.options[group]
    yield from (f"### {group}", "")
    if len(options) > 1:
        if default is not None:
            yield from (f"Default: `{default.typed}`.", "")
        yield from ("| option | description |", "|---|---|")
        yield from (f"| `{option.typed}` | {_prose(brief(option.about))} |" for option in options)
        yield ""
    yield from _table(each for option in options for each in option.settings)


def _table(settings: Iterable[Setting]) -> Iterator[str]:
    rows = {(each.key, each.meaning): each for each in settings if each.text and each.is_own}
    if not rows:
        return
    yield from ("| setting | description | type |", "|---|---|---|")
    for each in rows.values():
        takes = f"`{_cell(each.takes)}`" if each.takes else ""
        yield f"| `{each.key}={_cell(each.text)}` | {_prose(each.meaning)} | {takes} |"
    yield ""


def _prose(text: str) -> str:
    """Return a text whose dollars are no formulas."""
    return _cell(text).replace("$", "\\$")


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ").replace("<", "&lt;")

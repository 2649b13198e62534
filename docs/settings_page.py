"""The page of all settings: written by Sphinx when it builds the documents, from what `nerf help` reads."""

from collections.abc import Iterable, Iterator
from pathlib import Path

from nerf_lightning.cli.main import find_commands
from nerf_lightning.manual.catalogue import Command, Group, command_named
from nerf_lightning.manual.pages import said
from nerf_lightning.manual.settings import Setting

HEAD = """# Settings

This page is made of the docstrings and yamls that the program is built from; `nerf help NAME` prints the same for one
setting, group or option. A setting is given as `name=value`, an option of a group as `group=option`.
"""


def write(folder: Path) -> None:
    """Write `settings.md`: each command with its own settings, each group where it first comes up."""
    lines, told = [HEAD], set[str]()
    for name in sorted(find_commands(), key=lambda name: name != "train"):
        command = command_named(name)
        assert command is not None
        lines += [f"## nerf {name}", "", *_table(each for each in command.own if not each.is_section)]
        for group in command.groups:
            if group.typed not in told:
                told.add(group.typed)
                lines += _of_group(command, group)
    (folder / "settings.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _of_group(command: Command, group: Group) -> Iterator[str]:
    default = command.chosen.get(group.typed)
    yield from (f"### {group.typed}", "")
    if default is not None and len(group.options) > 1:
        yield from (f"`{default.name}` where nothing is said.", "")
    if len(group.options) > 1:
        yield from ("| option | what it is |", "|---|---|")
        yield from (f"| `{option.name}` | {_cell(option.summary)} |" for option in group.options)
        yield ""
    yield from _table(
        each for option in group.options for each in option.settings if each.meaning and not each.is_section
    )


def _table(settings: Iterable[Setting]) -> Iterator[str]:
    rows = {(each.key, each.meaning): each for each in settings}
    if not rows:
        return
    yield from ("| setting | what it means | takes |", "|---|---|---|")
    for each in rows.values():
        takes = f"{each.kind.words}{f': {each.bounds}' if each.bounds else ''}"
        yield f"| `{each.key}={_cell(each.text)}` | {_cell(said(each))} | {_cell(takes)} |"
    yield ""


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ").replace("<", "&lt;")

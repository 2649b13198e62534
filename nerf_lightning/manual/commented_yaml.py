"""A yaml file of conf/ with the comments that stand beside its settings: OmegaConf reads values alone."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import yaml

PACKAGE_LINE = "# @package"
END = re.compile(r"(?<=\.)\s+(?=[A-Z`*-]|$)|;\s")


@dataclass(frozen=True)
class Entry:
    """A setting as it is written, or a section of settings."""

    text: str = ""
    """The value as it stands in the file; empty for a section."""
    value: Any = None
    """And as Python has it."""
    comment: str = ""
    """What the lines above it and the end of its line say."""
    below: dict[str, "Entry"] = field(default_factory=dict)

    def over(self, base: "Entry") -> "Entry":
        """Return this section put over another one, as Hydra merges them; comments are the nearer one's."""
        below = {key: self.below[key].over(base.below[key]) for key in self.below if key in base.below}
        merged = base.below | self.below | below if self.below else {}
        return Entry(self.text, self.value, self.comment or base.comment, merged or ({} if self.text else base.below))


@dataclass(frozen=True)
class CommentedYaml:
    """One file."""

    root: Entry
    header: str
    """The comment at its top, if it is not that of the first setting: a paragraph."""
    defaults: tuple[tuple[str, str | None], ...]
    """Its defaults list in order: what is chosen from, with `/` and `@package` as written, and the option."""
    is_global: bool
    """Whether its keys stand for themselves (`@package _global_`), and not for what is below its group."""


@cache
def read_commented(file: Path) -> CommentedYaml:
    """Return a file's settings with their comments.

    Raises:
        OSError: it cannot be read.
        yaml.YAMLError: it is no yaml.
    """
    lines = file.read_text(encoding="utf-8").splitlines()
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)("\n".join(lines))
    node = loader.get_single_node()
    is_global = bool(lines) and lines[0].startswith(PACKAGE_LINE)
    header, first = _block(lines, 1 if is_global else 0)
    root, content = Entry(), {}
    if isinstance(node, yaml.MappingNode):
        content = loader.construct_document(node)
        root = _entry(node, content, lines)
    if first < len(lines) and re.match(r"[a-z]", lines[first]) and not lines[first].startswith("defaults"):
        header = ""  # directly above a setting: that one's
    root.below.pop("defaults", None)
    defaults = tuple(_chosen(content.get("defaults", [])))
    return CommentedYaml(root, header, defaults, is_global)


def brief(text: str) -> str:
    """Return the first sentence of a text, up to its semicolon, for a list.

    >>> brief("Shrink by 2.5 and more; else not. Others are refused.")
    'Shrink by 2.5 and more'
    """
    return END.split(text.replace("`", "").strip(), maxsplit=1)[0].removesuffix(".")


def _entry(node: yaml.MappingNode, value: dict[str, Any], lines: list[str]) -> Entry:
    below = {}
    for name, child in node.value:
        comment, own = _above(lines, name.start_mark.line, name.start_mark.column), value[name.value]
        if isinstance(child, yaml.MappingNode) and not child.flow_style:
            below[name.value] = Entry(comment=comment, below=_entry(child, own, lines).below)
            continue
        end = child.end_mark
        beside = lines[end.line][end.column :].partition("#")[2].strip() if end.line < len(lines) else ""
        below[name.value] = Entry(_as_typed(child, own), own, " ".join(filter(None, (comment, beside))))
    return Entry(below=below)


def _as_typed(node: yaml.Node, value: object) -> str:
    """Return a value as a person types it: numbers as the file has them."""
    return node.value if isinstance(node, yaml.ScalarNode) and node.value else _one_line(value)


def _one_line(value: object) -> str:
    return yaml.safe_dump(value, default_flow_style=True, width=1 << 20, sort_keys=False).strip()


def _above(lines: list[str], line: int, column: int) -> str:
    found: list[str] = []
    for above in reversed(lines[:line]):
        if not above[column:].startswith("#") or above[:column].strip() or above.startswith(PACKAGE_LINE):
            break
        found.insert(0, above[column:].lstrip("# "))
    return " ".join(found)


def _block(lines: list[str], start: int) -> tuple[str, int]:
    """Return the paragraph of comments that begins at a line, and the number of the line after all comments."""
    words: list[str] = []
    for number in range(start, len(lines)):
        if not lines[number].startswith("#"):
            return _paragraph(words), number
        words.append(lines[number].lstrip("#").strip())
    return _paragraph(words), len(lines)


def _paragraph(lines: list[str]) -> str:
    return " ".join(lines[: lines.index("")] if "" in lines else lines)


def _chosen(defaults: list[str | dict[str, str | None]]) -> Iterator[tuple[str, str | None]]:
    for each in defaults:
        if isinstance(each, str):
            yield each, None
        else:
            yield from each.items()

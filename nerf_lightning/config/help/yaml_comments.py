"""A YAML file of conf/ with the comments next to its settings, which OmegaConf drops."""

import re
from collections.abc import Iterator
from functools import cache
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

import yaml

HEADER = re.compile(r"(?:# @package.*\n)?((?:# (?!@).+\n)+)(?=#?\n|defaults|_|\{)")


class Entry(NamedTuple):
    """A setting as written, or a section of settings."""

    text: str
    """The value as written in the file; empty for a section."""
    type: str
    """Its YAML type, such as `int`, `bool` or `seq`."""
    comment: str
    """The comment lines above it and at the end of its line."""


class CommentedYaml(NamedTuple):
    """One file."""

    entries: dict[str, Entry]
    """By dotted key; sections come before their contents."""
    header: str
    """The comment at the top, unless it belongs to the first setting."""
    defaults: list[tuple[str, str | None]]
    """The defaults list: the group as written, with `/` and `@package`, and the option."""
    is_global: bool
    """Whether the keys are absolute (`@package _global_`)."""


@cache
def read_commented(file: Path) -> CommentedYaml:
    """Read a YAML file together with its comments."""
    text = file.read_text(encoding="utf-8")
    root = yaml.compose(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    sections = root.value if root else []
    defaults = [each for key, listed in sections if key.value == "defaults" for each in _defaults(listed)]
    entries = {key: entry for key, entry in _entries(sections, "", text.splitlines()) if key != "defaults"}
    header = HEADER.match(text)
    return CommentedYaml(entries, _joined(header[1].splitlines()) if header else "", defaults, text.startswith("# @pa"))


def _defaults(listed: yaml.Node) -> Iterator[tuple[str, str | None]]:
    for item in listed.value:
        for group, name in item.value if isinstance(item, yaml.MappingNode) else [(item, None)]:
            yield (
                group.value.removeprefix("optional "),
                None if name is None or name.tag.endswith("null") else name.value,
            )


def _entries(section: list[tuple[yaml.Node, yaml.Node]], prefix: str, lines: list[str]) -> Iterator[tuple[str, Entry]]:
    for name, node in section:
        indent = f"{' ' * name.start_mark.column}# "
        above = takewhile(lambda line: line.startswith(indent), reversed(lines[: name.start_mark.line]))  # noqa: B023
        comment = _joined(reversed([line for line in above if "@package" not in line]))
        if isinstance(node, yaml.MappingNode) and not node.flow_style:
            yield prefix + name.value, Entry("", "map", comment)
            yield from _entries(node.value, f"{prefix}{name.value}.", lines)
            continue
        beside = "".join(lines[node.end_mark.line :][:1])[node.end_mark.column :].partition("#")[2].strip()
        text = node.value if isinstance(node, yaml.ScalarNode) and node.value else yaml.serialize(node, width=1 << 20)
        yield prefix + name.value, Entry(text.strip(), node.tag.rpartition(":")[2], f"{comment} {beside}".strip())


def _joined(comment: Iterator[str] | list[str]) -> str:
    return " ".join(line.lstrip("# ") for line in comment)

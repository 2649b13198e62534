"""Yaml from strangers: plain values, without references, of bounded size.

`yaml.safe_load` makes no objects, but twelve lines of anchors and aliases become a billion entries as soon as somebody
walks through them, and merge keys (`<<`) do so while the file is read. No file that this program writes has any.
"""

from pathlib import Path
from typing import Any

import yaml

from nerf_lightning.files.budgets import require_text_within
from nerf_lightning.files.regular import read_text
from nerf_lightning.messages.errors import InputError

MOST_DEPTH, MOST_BITS = 50, 1000
"""Brackets within brackets; bits of a whole number: larger ones are no floating-point numbers."""
CURE = "It is damaged, or was made by somebody else: use another run folder or checkpoint."


class _PlainLoader(yaml.SafeLoader):
    """A loader that refuses references and deep nesting."""

    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("it holds references (*name), which are not read from files")
        self.depth += 1
        if self.depth > MOST_DEPTH:
            raise yaml.YAMLError(f"it nests more than {MOST_DEPTH} deep")
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


def plain_yaml(text: str, where: str | Path, cure: str = CURE) -> Any:
    """Return what a yaml text from anybody holds; `where` it stands, and the cure of a bad one, are for the message."""
    require_text_within("yaml", text, where)
    try:
        content = yaml.load(text, Loader=_PlainLoader)
        _require_plain(content)
        return content
    except yaml.YAMLError as error:
        raise InputError(f"{where} is not readable yaml: {' '.join(str(error).split())[:300]}. {cure}") from error
    except Exception as error:  # a date of the 99th month, a number of no digits: PyYAML lets many kinds through
        raise InputError(f"{where} holds a value that cannot be read ({type(error).__name__}). {cure}") from error


def read_plain_yaml(path: Path, cure: str = CURE) -> Any:
    """Return what a yaml file holds."""
    return plain_yaml(read_text(path, "yaml", cure), path, cure)


def _require_plain(content: Any) -> None:
    """Refuse what yaml knows and json does not: what reads a config sorts its keys, and writes its values down."""
    waiting = [content]
    while waiting:
        node = waiting.pop()
        if isinstance(node, dict):
            if len({type(key) for key in node}) > 1 or not all(isinstance(key, (str, int, float)) for key in node):
                raise ValueError("keys of other kinds than text, or of several")
            waiting += [*node, *node.values()]
        elif isinstance(node, list):
            waiting += node
        elif isinstance(node, int) and node.bit_length() > MOST_BITS:
            raise ValueError("a number that is too large")
        elif not (node is None or isinstance(node, (str, int, float))):
            raise ValueError("neither text nor a number")

"""Yaml from strangers: plain values, without references, of bounded size.

`yaml.safe_load` makes no objects, but twelve lines of anchors and aliases become a billion entries as soon as somebody
walks through them, and merge keys (`<<`) do so while the file is read. No file that this program writes has any.
"""

import json
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

    def construct_yaml_int(self, node: Any) -> int:
        if (number := super().construct_yaml_int(node)).bit_length() > MOST_BITS:
            raise yaml.YAMLError("it holds a number that is too large")
        return number


_PlainLoader.add_constructor("tag:yaml.org,2002:int", _PlainLoader.construct_yaml_int)


def plain_yaml(text: str, where: str | Path, cure: str = CURE) -> Any:
    """Return what a yaml text from anybody holds; `where` it stands, and the cure of a bad one, are for the message."""
    require_text_within("yaml", text, where)
    try:
        content = yaml.load(text, Loader=_PlainLoader)
        json.dumps(content, sort_keys=True)  # refuses what json has not: dates, bytes, sets, keys of several kinds
        return content
    except yaml.YAMLError as error:
        raise InputError(f"{where} is not readable yaml: {' '.join(str(error).split())[:300]}. {cure}") from error
    except Exception as error:  # a date of the 99th month, a number of no digits: PyYAML lets many kinds through
        raise InputError(f"{where} holds a value that cannot be read ({type(error).__name__}). {cure}") from error


def read_plain_yaml(path: Path, cure: str = CURE) -> Any:
    """Return what a yaml file holds."""
    return plain_yaml(read_text(path, "yaml", cure), path, cure)

"""Untrusted YAML: plain values of bounded size, without references.

`yaml.safe_load` makes no objects, but twelve lines of anchors and aliases become a billion entries when they are
traversed, and merge keys (`<<`) do so while the file is read. Files that this program writes have neither.
"""

import json
from pathlib import Path
from typing import Any

import yaml

from nerf_lightning.files.budgets import require_text_within
from nerf_lightning.files.regular import read_text
from nerf_lightning.messages.errors import InputError

MOST_DEPTH, MOST_BITS = 50, 1000
"""Maximum nesting of brackets; maximum bits of an integer: larger ones do not fit into a float."""
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
    """Return the content of an untrusted YAML text; `where` it is, and the cure of a bad one, are for the message."""
    require_text_within("yaml", text, where)
    try:
        content = yaml.load(text, Loader=_PlainLoader)
        json.dumps(content, sort_keys=True)  # refuses what JSON lacks: dates, bytes, sets, keys of mixed types
        return content
    except yaml.YAMLError as error:
        raise InputError(f"{where} is not readable yaml: {' '.join(str(error).split())[:300]}. {cure}") from error
    except Exception as error:  # a date in the 99th month, a number without digits: PyYAML raises many kinds
        raise InputError(f"{where} holds a value that cannot be read ({type(error).__name__}). {cure}") from error


def read_plain_yaml(path: Path, cure: str = CURE) -> Any:
    """Return the content of a YAML file."""
    return plain_yaml(read_text(path, "yaml", cure), path, cure)

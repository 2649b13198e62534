"""Read JSON files, reporting their mistakes, and write them."""

import json
import math
from collections import Counter
from pathlib import Path
from typing import Any

from nerf_lightning.files.atomic import whole_file
from nerf_lightning.files.regular import read_text
from nerf_lightning.files.signatures import other_format
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed

CURE = "Export it again, or fix it with a JSON checker."


def read_json(path: Path) -> Any:
    """Return the content of a JSON file."""
    try:
        return parse_json(read_text(path, "json", CURE), path)
    except InputError as error:
        if (other := other_format(path)) is None:
            raise
        raise InputError(f"{path} is {other}.") from error


def parse_json(text: str, where: Path) -> Any:
    """Return the content of a JSON text from `where`."""
    try:
        return json.loads(text, object_pairs_hook=_object)
    except json.JSONDecodeError as error:
        place = f"line {error.lineno}, column {error.colno}"
        raise InputError(f"{where} is not valid json: {error.msg} at {place}. {CURE}") from error
    except RecursionError as error:
        raise InputError(f"{where} nests its brackets too deeply to be a capture. {CURE}") from error
    except ValueError as error:  # a number with thousands of digits
        raise InputError(f"{where} is not usable json: {error}. {CURE}") from error


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        twice = next(key for key, count in Counter(key for key, _ in pairs).items() if count > 1)
        raise ValueError(f"the key {twice[:200]!r} appears twice in one object, and it is unclear which one applies")
    return content


def keys_of(content: object, keys: tuple[str, ...], where: str, wanted_by: str) -> list[Any]:
    """Return the values of required keys; `where` and the format (`wanted_by`) are for messages."""
    if not isinstance(content, dict):
        raise InputError(
            f"{where} must be a json object with the keys {listed(keys)}, but it is {type(content).__name__}."
        )
    missing = [key for key in keys if key not in content]
    if missing:
        raise InputError(
            f"{where} lacks {listed(missing)}; it has {listed(content) or 'nothing'}. {wanted_by} needs {listed(keys)}."
        )
    return [content[key] for key in keys]


LARGEST = 1e30


def read_json_object(path: Path) -> dict[str, Any]:
    """Return the content of a JSON file; empty if it is missing, damaged or not an object."""
    try:
        return mapping(read_json(path))
    except InputError:
        return {}


def mapping(value: object) -> dict[str, Any]:
    """Return an object from a file; an empty one if it is anything else."""
    return value if isinstance(value, dict) else {}


def number(value: Any) -> float | None:
    """Return a number from a file; None if it is anything else, including NaN."""
    if not isinstance(value, (int, float)) or isinstance(value, bool) or abs(value) > LARGEST or value != value:
        return None
    return float(value)


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file atomically; NaN and infinity, which JSON lacks, become null."""
    with whole_file(path) as part:
        part.write_text(json.dumps(_finite(content), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def print_json(value: object) -> None:
    """Print a value as JSON to stdout, all of it in ASCII, which steers no terminal."""
    print(json.dumps(_finite(value), indent=2, default=str, allow_nan=False), flush=True)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value

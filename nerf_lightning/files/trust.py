"""The one rule for untrusted files: nothing in them runs, and everything has the required type.

Weights and optimizer state match a template, which this config builds; all else matches its annotations. Integers that
index or size memory are checked against their range where they are used. Numbers are not judged individually: a file
may contain a wrong scene, but nothing harmful.
"""

import math
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import torch
from jaxtyping import AbstractArray
from torch import Tensor

from nerf_lightning.files.signatures import other_format
from nerf_lightning.messages.errors import InputError

LARGEST_COUNT = 1 << 53  # Integers beyond are not counts: doubles cannot distinguish them
CURE = "It is damaged, or was made by somebody else: use another one."


class Mismatch(ValueError):
    """The first invalid value: where it is, and what is wrong with it."""

    def __str__(self) -> str:
        return " ".join(self.args)


@contextmanager
def reading(path: Path | str, cure: str = CURE) -> Iterator[None]:
    """Turn any exception raised while reading a broken file into one paragraph that names the file."""
    try:
        yield
    except InputError:
        raise
    except Mismatch as problem:
        raise InputError(f"{path} is damaged, or was made by somebody else: {problem}. {cure}") from problem
    except Exception as error:
        if (other := other_format(Path(path))) is not None:
            raise InputError(f"{path} is {other}.") from error
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path} cannot be read ({type(error).__name__}: {reason}). {cure}") from error


def require_fit(value: object, kind: Any, name: str, optional: Mapping[str, Any] | None = None) -> None:
    """Refuse a value that does not match an annotation or a template.

    Args:
        value: as read; nothing is known about it.
        kind: an annotation of plain values, containers and tensors with shapes (`object` is anything), or a template of
            them: dictionaries and lists of kinds, tensors, which may be on `meta`, and plain values, of which only the
            type counts. A dataclass represents a dictionary of its fields.
        name: the keys from the file's top, for messages.
        optional: keys that a dictionary may also have; for a dataclass, those with a default.

    Raises:
        Mismatch: other keys, lengths, types, shapes or dtypes, an integer outside 0 to 2^53, NaN or infinity.
    """
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        if value is not None or NoneType not in parts:
            require_fit(value, next(part for part in parts if part is not NoneType), name)
    elif origin in (Literal, Annotated):
        options = range(parts[1], parts[2] + 1) if origin is Annotated else parts
        if type(value) is not type(options[0]) or value not in options:
            either = f"from {parts[1]} to {parts[2]}" if origin is Annotated else " or ".join(map(str, parts))
            raise Mismatch(name, f"is {for_message(value)}, not {either}")
    elif isinstance(kind, Tensor) or (isinstance(kind, type) and issubclass(kind, (Tensor, AbstractArray))):
        _require_tensor(value, kind, name)
    elif origin in (dict, list, tuple) or is_dataclass(kind) or isinstance(kind, (Mapping, list, tuple)):
        for entry, its_kind, its_name in _entries(value, kind, name, optional or {}):
            require_fit(entry, its_kind, its_name)
    elif kind is not object:
        _require_number_or_word(value, kind if isinstance(kind, type) else type(kind), name)


def _entries(value: Any, kind: Any, name: str, optional: Mapping[str, Any]) -> Iterator[tuple[Any, Any, str]]:
    """Check a container, and yield its elements with their kinds and places."""
    origin, parts = get_origin(kind), get_args(kind)
    if (origin or type(kind)) in (list, tuple):
        _require_type(value, origin or type(kind), name)
        if origin is None and len(value) != len(kind):
            raise Mismatch(name, f"has {len(value)} entries, not {len(kind)}")
        kinds = kind if origin is None else [parts[0]] * len(value)
        yield from ((entry, kinds[number], f"{name}[{number}]") for number, entry in enumerate(value))
        return
    _require_type(value, dict, name)
    if origin is dict:
        for key in value:
            require_fit(key, parts[0], f"a key of {name}")
        kinds = dict.fromkeys(value, parts[1])
    elif is_dataclass(kind):
        kinds = {field.name: field.type for field in fields(kind)}
        optional = {key: kinds[key] for key in kinds if hasattr(kind, key)}
    else:
        kinds = {**kind, **optional}
    for key in (*kinds, *value):
        if key not in kinds or (key not in value and key not in optional):
            raise Mismatch(_below(name, key), "is missing" if key in kinds else "belongs to no file of this kind")
    yield from ((entry, kinds[key], _below(name, key)) for key, entry in value.items())


def _require_tensor(value: Any, kind: Any, name: str) -> None:
    _require_type(value, Tensor, name)
    if isinstance(kind, Tensor):
        fits, ours = (value.shape, value.dtype) == (kind.shape, kind.dtype), f"{kind.dtype} in {tuple(kind.shape)}"
    elif kind is Tensor:
        fits, ours = True, ""
    else:  # floating-point numbers are float32 unless another type is annotated
        exact = value.dtype in (torch.float32, torch.int64, torch.uint8) or kind.dtypes == ("float64",)
        fits, ours = exact and isinstance(value, kind), f"{kind.__name__.partition('[')[0]} in ({kind.dim_str})"
    if not fits:
        raise Mismatch(name, f"holds {value.dtype} in the shape {tuple(value.shape)}, not {ours}")
    if value.is_floating_point() and not bool(torch.isfinite(value).all()):
        raise Mismatch(name, "holds NaN or infinity")


def _require_number_or_word(value: Any, kind: type, name: str) -> None:
    if kind is not float:
        _require_type(value, kind, name)
    elif type(value) not in (int, float) or not abs(value) <= sys.float_info.max:
        raise Mismatch(name, f"is {for_message(value)}, not a finite number")
    if kind is int and not 0 <= value <= LARGEST_COUNT:
        raise Mismatch(name, f"is {for_message(value)}, not a whole number from 0 to {LARGEST_COUNT}")


def _require_type(value: Any, kind: type, name: str) -> None:
    if not (isinstance(value, kind) if kind in (dict, Tensor) else type(value) is kind):
        raise Mismatch(name or "the file", f"is {for_message(value)}, not of the type {kind.__name__}")


def _below(name: str, key: object) -> str:
    entry = ascii(str(key)[:200])[1:-1]
    return f"{name}.{entry}" if name else entry


def for_message(value: object) -> str:
    """Return a value for a message: in full if it is short and plain, else its kind.

    >>> for_message("a"), for_message(3), for_message({"a": 1}), for_message(10**200), for_message(10**5000)
    ("'a'", '3', 'a dict', 'a number of 201 digits', 'a number of 5001 digits')
    """
    if isinstance(value, str):
        return ascii(value if len(value) <= 40 else value[:40] + "...")
    if isinstance(value, int) and abs(value) >= 10**20:
        return f"a number of {int(value.bit_length() * math.log10(2)) + 1} digits"
    return str(value) if isinstance(value, (int, float, NoneType)) else f"a {type(value).__name__}"

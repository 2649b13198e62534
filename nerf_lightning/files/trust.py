"""The one rule for files that anybody may have made.

* Nothing in a file runs. PyTorch files are read with `weights_only`, yaml and json as data; classes come from an
  allow-list (`checkpoints.trusted_classes`), settings from an allow-list by group (`config.key_meanings`).
* Weights and optimizer state must have the keys, shapes and dtypes of a template, which is what this config builds, and
  be finite (`require_like`). Quantized weights are unpacked within `budgets.unpacked_bytes` first.
* What stands beside them has the keys and kinds of its annotations (`require_fit`); a scene also passes the checks of
  every capture (`data.captures.checks.check_scene`).
* Integers that index or size memory are checked against their range, where they are used.
* Anything else that a broken file raises while it is read becomes one paragraph that names the file (`reading`).

Numbers are not judged one by one: a file may hold a wrong scene, but no harm.
"""

import math
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import torch
from jaxtyping import AbstractArray
from torch import Tensor

from nerf_lightning.messages.errors import InputError

MOST = 1 << 53  # Whole numbers beyond are no counts: a double cannot tell them apart
RECORDED = (torch.float32, torch.int64, torch.uint8)  # Types of tensors with annotated shapes
CURE = "It is damaged, or was made by somebody else: use another one."


class Mismatch(ValueError):
    """Report the first value that is not what it must be: its place, and what is wrong with it."""

    def __init__(self, place: str, problem: str):
        super().__init__(f"{place} {problem}")


@contextmanager
def reading(path: Path | str, cure: str = CURE) -> Iterator[None]:
    """Turn whatever a broken file raises while it is read into one paragraph that names the file."""
    try:
        yield
    except InputError:
        raise
    except Mismatch as problem:
        raise InputError(f"{path} is damaged, or was made by somebody else: {problem}. {cure}") from problem
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path} cannot be read ({type(error).__name__}: {reason}). {cure}") from error


def require_like(found: object, template: object, place: str) -> None:
    """Refuse what differs from a template of dictionaries, lists, tensors and plain values.

    Args:
        found: as it was read; nothing is known of it.
        template: tensors may be on `meta`. Of plain values only the type counts.
        place: the keys from the file's top, for messages.

    Raises:
        Mismatch: other keys, lengths, types, shapes or dtypes, or numbers that are not finite.
    """
    if isinstance(template, Mapping):
        table = _dict(found, place)
        for key in [key for key in (*template, *table) if key not in table or key not in template]:
            problem = "is missing" if key in template else "belongs to no part of this run"
            raise Mismatch(f"{place}.{_name(key)}", problem)
        for key, entry in template.items():
            require_like(table[key], entry, f"{place}.{key}")
    elif isinstance(template, (list, tuple)):
        if type(found) is not type(template) or len(found) != len(template):
            raise Mismatch(place, f"is {shown(found)}, not a {type(template).__name__} of {len(template)}")
        for number, (entry, ours) in enumerate(zip(found, template, strict=True)):
            require_like(entry, ours, f"{place}[{number}]")
    elif isinstance(template, Tensor):
        _require_tensor(found, place)
        assert isinstance(found, Tensor)
        if (found.shape, found.dtype) != (template.shape, template.dtype):
            ours = f"{template.dtype} in {tuple(template.shape)}"
            raise Mismatch(place, f"holds {found.dtype} in the shape {tuple(found.shape)}, and the run's {ours}")
    else:
        require_fit(found, type(template), place)


def require_fit(value: object, kind: Any, place: str, optional: Mapping[str, Any] | None = None) -> None:
    """Refuse what does not fit an annotation.

    Args:
        value: as it was read; nothing is known of it.
        kind: an annotation of plain values, containers and tensors with shapes; a dataclass, or a dictionary of
            annotations, stands for a dictionary of its keys. `object` is anything.
        place: the keys from the file's top, for messages.
        optional: keys that a dictionary of annotations may also have; of a dataclass they are those with a default.

    Raises:
        Mismatch: other keys or kinds, a whole number beyond 0 to 2^53, or one that is not finite.
    """
    origin, parts = get_origin(kind), get_args(kind)
    if isinstance(kind, dict) or is_dataclass(kind):
        _require_keys(value, kind, place, optional or {})
    elif origin in (Union, UnionType):
        if not (value is None and NoneType in parts):
            require_fit(value, next(part for part in parts if part is not NoneType), place)
    elif origin in (Literal, Annotated):
        options = range(parts[1], parts[2] + 1) if origin is Annotated else parts
        require_fit(value, type(options[0]), place)
        if value not in options:
            either = f"from {parts[1]} to {parts[2]}" if origin is Annotated else " or ".join(map(str, parts))
            raise Mismatch(place, f"is {shown(value)}, not {either}")
    elif origin is dict:
        for key, entry in _dict(value, place).items():
            require_fit(key, parts[0], f"a key of {place}")
            require_fit(entry, parts[1], f"{place}.{_name(key)}")
    elif origin in (list, tuple):
        _require_kind(value, origin, place)
        for number, entry in enumerate(value):  # type: ignore[arg-type]
            require_fit(entry, parts[0], f"{place}[{number}]")
    else:
        _require_value(value, kind, place)


def _require_keys(value: object, kind: Any, place: str, optional: Mapping[str, Any]) -> None:
    kinds, must = kind, set(kind) if isinstance(kind, dict) else set()
    if not isinstance(kind, dict):
        kinds = {field.name: field.type for field in fields(kind)}
        must = {field.name for field in fields(kind) if field.default is field.default_factory is MISSING}
    kinds = {**kinds, **optional}
    found = _dict(value, place)
    for key in [key for key in found if key not in kinds]:
        raise Mismatch(place, f"holds {shown(key)}, which no file of this program does")
    for key in sorted(must - found.keys()):
        raise Mismatch(place, f"lacks {key}")
    for key, entry in found.items():
        require_fit(entry, kinds[key], f"{place}.{key}" if place else str(key))


def _require_value(value: object, kind: Any, place: str) -> None:
    if kind is object:
        return
    if kind is Tensor or (isinstance(kind, type) and issubclass(kind, AbstractArray)):
        _require_tensor(value, place)
        assert isinstance(value, Tensor)
        recorded = (*RECORDED, torch.float64) if getattr(kind, "dtypes", ()) == ("float64",) else RECORDED
        if kind is not Tensor and not (value.dtype in recorded and isinstance(value, kind)):
            shape: Any = kind
            ours = f"{kind.__name__.partition('[')[0].lower()} in the shape ({shape.dim_str})"
            raise Mismatch(place, f"holds {value.dtype} in the shape {tuple(value.shape)}, not {ours}")
    elif kind is float:
        if type(value) not in (int, float) or not abs(value) <= sys.float_info.max:  # type: ignore[arg-type]
            raise Mismatch(place, f"is {shown(value)}, not a finite number")
    elif type(value) is not kind:
        raise Mismatch(place, f"is {shown(value)}, not of type {kind.__name__}")
    elif kind is int and not 0 <= value <= MOST:  # type: ignore[operator]
        raise Mismatch(place, f"is {shown(value)}, not a whole number from 0 to {MOST}")


def _require_tensor(value: object, place: str) -> None:
    if not isinstance(value, Tensor) or value.layout != torch.strided or value.is_quantized:
        raise Mismatch(place, f"is {shown(value)}, not a tensor of numbers")
    if value.is_floating_point() and not bool(torch.isfinite(value).all()):
        raise Mismatch(place, "holds NaN or infinity")


def _require_kind(value: object, kind: type, place: str) -> None:
    if type(value) is not kind:
        raise Mismatch(place, f"is {shown(value)}, not a {kind.__name__}")


def _dict(value: object, place: str) -> dict[Any, Any]:
    if not isinstance(value, dict):
        raise Mismatch(place, f"is {shown(value)}, not a dict")
    return value


def _name(key: object) -> str:
    return ascii(str(key)[:200])[1:-1]


def shown(value: object) -> str:
    """Return a value as a message shows it: in full where it is short and plain, else what kind of thing it is.

    >>> shown("a"), shown(3), shown({"a": 1}), shown(10**200)
    ("'a'", '3', 'a dict', 'a number of 201 digits')
    """
    if isinstance(value, str):
        return ascii(value if len(value) <= 40 else value[:40] + "...")
    if isinstance(value, (bool, float, type(None))):
        return str(value)
    if isinstance(value, int):
        digits = int(value.bit_length() * math.log10(2)) + 1
        return str(value) if digits <= 20 else f"a number of {digits} digits"
    return f"a {type(value).__name__}"

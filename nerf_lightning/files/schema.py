"""What a value from a file must be: its type, shape, range and size, said once and held against whatever is read.

A description is made of the small classes below. Whoever writes a file and whoever reads it use the same description,
so that the two cannot drift apart; the tests draw their malformed files from it too.
"""

import math
import re
import sys
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

MOST = 1 << 53
"""Whole numbers beyond are no counts: a double cannot tell them apart."""


class Unfit(ValueError):
    """Report the first value that is not what was described: its place, and what is wrong with it, in a few words."""

    def __init__(self, place: str, problem: str):
        super().__init__(f"{place} {problem}")


class Description(ABC):
    """What one value must be."""

    @abstractmethod
    def require(self, value: object, place: str, sizes: dict[str, int]) -> None:
        """Hold a value against the description.

        Args:
            value: as it was read; nothing is known of it.
            place: its keys from the file's top, with points between them.
            sizes: what the named sides of tensors were found to be so far; new ones are added.

        Raises:
            Unfit: it is anything else.
        """


@dataclass(frozen=True)
class Flag(Description):
    """True or false."""

    def require(self, value: object, place: str, sizes: dict[str, int]) -> None:
        """See `Description`."""
        if type(value) is not bool:
            raise Unfit(place, f"is {shown(value)}, not true or false")


@dataclass(frozen=True)
class Whole(Description):
    """A whole number."""

    low: int = 0
    high: int = MOST

    def require(self, value: object, place: str, sizes: dict[str, int]) -> None:
        """See `Description`."""
        if type(value) is not int or not self.low <= value <= self.high:
            raise Unfit(place, f"is {shown(value)}, not a whole number from {self.low} to {self.high}")


@dataclass(frozen=True)
class Number(Description):
    """A finite number."""

    low: int | float = -math.inf
    high: int | float = math.inf

    def require(self, value: object, place: str, sizes: dict[str, int]) -> None:
        """See `Description`."""
        sound = isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
        if not sound or not self.low <= value <= self.high:  # type: ignore[operator]
            raise Unfit(place, f"is {shown(value)}, not a finite number from {self.low:g} to {self.high:g}")


@dataclass(frozen=True)
class Text(Description):
    """Text of so many characters at most, that fits a pattern where there is one."""

    longest: int
    pattern: str = ""

    def require(self, value: object, place: str, sizes: dict[str, int]) -> None:
        """See `Description`."""
        if type(value) is not str:
            raise Unfit(place, f"is {shown(value)}, not text")
        if len(value) > self.longest:
            raise Unfit(place, f"has {len(value):,} characters, more than {self.longest:,}")
        if self.pattern and not re.fullmatch(self.pattern, value):
            raise Unfit(place, f"is {shown(value)}")


@dataclass(frozen=True)
class Choice(Description):
    """One of some words or numbers."""

    options: tuple[str | int, ...]

    def require(self, value: object, place: str, sizes: dict[str, int]) -> None:
        """See `Description`."""
        if not any(type(value) is type(option) and value == option for option in self.options):
            raise Unfit(place, f"is {shown(value)}, not {' or '.join(map(str, self.options))}")


@dataclass(frozen=True)
class Maybe(Description):
    """None, or what `known` says."""

    known: Description

    def require(self, value: object, place: str, sizes: dict[str, int]) -> None:
        """See `Description`."""
        if value is not None:
            self.known.require(value, place, sizes)


@dataclass(frozen=True)
class Many(Description):
    """A list or a tuple of likes.

    A side of a tensor may have the name of its length (`size`).
    """

    each: Description
    most: int
    kind: type = list
    least: int = 0
    size: str | None = None

    def require(self, value: object, place: str, sizes: dict[str, int]) -> None:
        """See `Description`."""
        if type(value) is not self.kind:
            raise Unfit(place, f"is {shown(value)}, not a {self.kind.__name__}")
        assert isinstance(value, Sequence)
        if not self.least <= len(value) <= self.most:
            raise Unfit(place, f"has {len(value):,} entries, not {self.least:,} to {self.most:,}")
        if self.size is not None and sizes.setdefault(self.size, len(value)) != len(value):
            raise Unfit(place, f"has {len(value):,} entries, where there are {sizes[self.size]:,} {self.size}")
        for number, entry in enumerate(value):
            self.each.require(entry, f"{place}[{number}]", sizes)


@dataclass(frozen=True)
class Record(Description):
    """A dictionary of these keys and no others."""

    keys: Mapping[str, Description]
    optional: Mapping[str, Description] = field(default_factory=dict)

    def require(self, value: object, place: str, sizes: dict[str, int]) -> None:
        """See `Description`."""
        if not isinstance(value, dict):
            raise Unfit(place, f"is {shown(value)}, not a dictionary")
        known = {**self.keys, **self.optional}
        unknown = [shown(key) for key in value if key not in known]
        missing = [key for key in self.keys if key not in value]
        if unknown:
            raise Unfit(place, f"holds {', '.join(unknown[:3])}, which no file of this program does")
        if missing:
            raise Unfit(place, f"lacks {', '.join(missing[:3])}")
        for key, entry in value.items():
            known[key].require(entry, f"{place}.{key}" if place else key, sizes)


@dataclass(frozen=True)
class Named(Description):
    """A dictionary from names, or numbers, to likes."""

    name: Text | Whole
    each: Description
    most: int

    def require(self, value: object, place: str, sizes: dict[str, int]) -> None:
        """See `Description`."""
        if not isinstance(value, dict):
            raise Unfit(place, f"is {shown(value)}, not a dictionary")
        if len(value) > self.most:
            raise Unfit(place, f"has {len(value):,} entries, more than {self.most:,}")
        for key, entry in value.items():
            self.name.require(key, f"a key of {place}", sizes)
            self.each.require(entry, f"{place}.{shown(key)}", sizes)


@dataclass(frozen=True)
class Numbers(Description):
    """A tensor of finite numbers; a side is a length, or a name that stands for the same length everywhere."""

    shape: tuple[int | str, ...] | None = None
    dtypes: tuple[torch.dtype, ...] = (torch.float32,)
    low: int | float = -math.inf
    high: int | float = math.inf

    def require(self, value: object, place: str, sizes: dict[str, int]) -> None:
        """See `Description`."""
        if not isinstance(value, Tensor) or value.layout != torch.strided or value.is_quantized:
            raise Unfit(place, f"is {shown(value)}, not a tensor of numbers")
        if value.dtype not in self.dtypes:
            raise Unfit(place, f"holds {_dtype(value.dtype)}, not {' or '.join(map(_dtype, self.dtypes))}")
        if self.shape is not None:
            self._require_shape(value, place, sizes)
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
            raise Unfit(place, "holds NaN or infinity")
        if value.numel() and (self.low > -math.inf or self.high < math.inf):
            lowest, highest = (float(end) for end in value.aminmax())
            if not self.low <= lowest <= highest <= self.high:
                raise Unfit(place, f"has numbers from {lowest:g} to {highest:g}, not {self.low:g} to {self.high:g}")

    def _require_shape(self, value: Tensor, place: str, sizes: dict[str, int]) -> None:
        assert self.shape is not None
        if len(self.shape) == value.dim():
            for side, length in zip(self.shape, value.shape, strict=True):
                if isinstance(side, str):
                    sizes.setdefault(side, length)
        wanted = tuple(sizes.get(side, -1) if isinstance(side, str) else side for side in self.shape)
        if value.shape != wanted:
            raise Unfit(place, f"has the shape {tuple(value.shape)}, not {wanted}")


@dataclass(frozen=True)
class Plain(Description):
    """Anything made of numbers, words, lists and dictionaries that is not deeper than `depth`, nor more than `most`.

    There may be tensors in it where that is said.
    """

    depth: int = 8
    most: int = 1 << 20
    tensors: bool = False

    def require(self, value: object, place: str, sizes: dict[str, int]) -> None:
        """See `Description`."""
        level, found = [value], 0
        for _ in range(self.depth + 1):
            found += len(level)
            below: list[object] = []
            for node in level:
                if isinstance(node, dict):
                    below += [*node.keys(), *node.values()]
                elif isinstance(node, (list, tuple)):
                    below += node
                elif not (node is None or isinstance(node, (bool, int, float, str, *([Tensor] * self.tensors)))):
                    raise Unfit(place, f"holds a {type(node).__name__}")
            level = below
            if found + len(level) > self.most:
                raise Unfit(place, f"holds more than {self.most:,} values")
            if not level:
                return
        raise Unfit(place, f"nests more than {self.depth} deep")


def like(example: object) -> Description:
    """Return the description of what has the same keys and types as an example of plain counts and flags."""
    if isinstance(example, dict):
        return Record({key: like(entry) for key, entry in example.items()})
    if isinstance(example, bool):
        return Flag()
    if isinstance(example, int):
        return Whole()
    raise TypeError(f"no description of a {type(example).__name__}")


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
    if isinstance(value, Tensor):
        return f"a tensor of {_dtype(value.dtype)}"
    return f"a {type(value).__name__}"


def _dtype(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")

"""Weights that a checkpoint holds in fewer bytes: tables as smaller numbers, rows left out, switches as bits.

What is read back are the tensors that a model loads, in float32. The record is tensors, numbers and words alone, and
how large it may become in memory is held to a budget before anything is made (`budgets.unpacked_bytes`).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.trust import Mismatch

NumberType = Literal["float32", "float16", "int8"]
TYPES: dict[NumberType, torch.dtype] = {"float32": torch.float32, "float16": torch.float16, "int8": torch.int8}
SWITCHES = {"bool": torch.bool, "uint8": torch.uint8}
LARGEST_INT8 = 127


@dataclass(frozen=True)
class QuantizedRows:
    """A table in a checkpoint, as `quantize_rows` has it."""

    shape: list[int]
    starts: list[int]
    kept: UInt8[Tensor, "_"] | None
    values: Tensor
    scales: Tensor
    means: Tensor


@dataclass(frozen=True)
class QuantizedSwitches:
    """A tensor of zeros and ones in a checkpoint, as `quantize_switches` has it."""

    shape: list[int]
    type: Literal["bool", "uint8"]
    bits: UInt8[Tensor, "_"]


@dataclass(frozen=True)
class Quantized:
    """All of them, by the names of the weights."""

    rows: dict[str, QuantizedRows]
    switches: dict[str, QuantizedSwitches]


def quantize_rows(
    table: Float[Tensor, "..."],
    number: NumberType,
    starts: Sequence[int] = (0,),
    kept: Bool[Tensor, "rows"] | None = None,
) -> dict[str, Any]:
    """Return a table as it is kept: int8 in units of its block's largest magnitude over 127.

    Args:
        table: rows of features along the last axis; of one with more than two axes each number is a row.
        number: the type that its numbers are kept in.
        starts: the first row of each of its blocks (a hash grid's levels).
        kept: the rows that are; the others come back as their block's mean of them. None: all.
    """
    rows = table.detach().float().cpu()
    rows = rows if rows.ndim == 2 else rows.reshape(-1, 1)
    kept = torch.ones(rows.shape[0], dtype=torch.bool) if kept is None else kept
    ends = [*starts[1:], rows.shape[0]]
    blocks = [(rows[a:b][kept[a:b]], rows[a:b][~kept[a:b]]) for a, b in zip(starts, ends, strict=True)]
    largest = torch.stack([inside.abs().max() if inside.numel() else torch.tensor(0.0) for inside, _ in blocks])
    scales = torch.where(largest > 0, largest / LARGEST_INT8, 1.0) if number == "int8" else torch.ones_like(largest)
    values = rows[kept] / scales[_block_of(starts, rows.shape[0])[kept], None]
    return {
        "shape": list(table.shape),
        "starts": list(starts),
        "kept": None if bool(kept.all()) else to_bits(kept),
        "values": (values.round() if number == "int8" else values).to(TYPES[number]),
        "scales": scales,
        "means": torch.stack([left.sum(0) / max(1, left.shape[0]) for _, left in blocks]),
    }


def quantize_switches(switches: Tensor) -> dict[str, Any]:
    """Return a tensor of zeros and ones, of type bool or uint8, as it is kept."""
    kind = next(name for name, dtype in SWITCHES.items() if dtype == switches.dtype)
    return {"shape": list(switches.shape), "type": kind, "bits": to_bits(switches.flatten().bool().cpu())}


def to_bits(switches: Bool[Tensor, "n"]) -> UInt8[Tensor, "bytes"]:
    """Return switches as bytes, the first in the lowest bit.

    >>> to_bits(torch.tensor([True, False, True, False, False, False, False, False, True])).tolist()
    [5, 1]
    """
    return torch.from_numpy(np.packbits(switches.numpy(), bitorder="little"))


def from_bits(bits: UInt8[Tensor, "bytes"], count: int) -> Bool[Tensor, "count"]:
    """Return the first switches that bytes hold."""
    return torch.from_numpy(np.unpackbits(bits.numpy(), count=count, bitorder="little")).bool()


def dequantized(quantized: Mapping[str, Any], where: str) -> dict[str, Tensor]:
    """Return the tensors that quantized weights stand for; whoever loads them compares them with a template.

    Args:
        quantized: as `Quantized` describes it.
        where: the file, for messages.

    Raises:
        Mismatch: its parts do not fit each other.
        InputError: it would take more memory than a person has agreed to.
    """
    rows = {name: QuantizedRows(**table) for name, table in quantized["rows"].items()}
    switches = {name: QuantizedSwitches(**each) for name, each in quantized["switches"].items()}
    size = sum(4 * math.prod(each.shape) for each in rows.values())
    size += sum(math.prod(each.shape) for each in switches.values())
    require_within("unpacked_bytes", size, where, "bytes of quantized weights, once they are unpacked")
    tables = {name: _table(each, f"quantized.rows.{name}") for name, each in rows.items()}
    return tables | {
        name: from_bits(each.bits, math.prod(each.shape)).to(SWITCHES[each.type]).view(each.shape)
        for name, each in switches.items()
    }


def _table(table: QuantizedRows, place: str) -> Tensor:
    width = table.shape[1] if len(table.shape) == 2 else 1
    count = math.prod(table.shape) // max(1, width)
    if table.values.shape[1:] != (width,) or table.means.shape != (len(table.starts), width):
        raise Mismatch(place, f"has rows of {tuple(table.values.shape)} in a table of {table.shape}")
    kept = torch.ones(count, dtype=torch.bool) if table.kept is None else from_bits(table.kept, count)
    block = _block_of(table.starts, count)
    rows = table.means[block]
    rows[kept] = table.values.float() * table.scales[block[kept], None]
    return rows.view(table.shape)


def _block_of(starts: Sequence[int], count: int) -> Tensor:
    sizes = torch.tensor([b - a for a, b in zip(starts, [*starts[1:], count], strict=True)])
    return torch.repeat_interleave(torch.arange(len(starts)), sizes)

"""Weights stored in fewer bytes: tables as smaller numbers, rows left out, switches as bits.

Reading returns the tensors that a model loads, in float32. The record consists only of tensors, numbers and words, and
its unpacked size is checked against a budget before anything is allocated (`budgets.unpacked_bytes`).

Which weights are quantized, and how: `extensions/pruning/quantized_weights.py`.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Int, UInt8
from torch import Tensor

from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.trust import Mismatch

SWITCHES = {"bool": torch.bool, "uint8": torch.uint8}


@dataclass(frozen=True)
class QuantizedRows:
    """A quantized table in a checkpoint (written by `nerf prune`)."""

    shape: list[int]
    starts: list[int]
    """The first row of each of its blocks."""
    kept: UInt8[Tensor, "_"] | None
    """Which rows are kept, as bits; the others are their block's mean. None: all."""
    values: Tensor
    """The kept rows, in units of their block's scale."""
    scales: Tensor
    means: Tensor


@dataclass(frozen=True)
class QuantizedSwitches:
    """A tensor of zeros and ones in a checkpoint, as bits, the first in the lowest bit of a byte."""

    shape: list[int]
    type: Literal["bool", "uint8"]
    bits: UInt8[Tensor, "_"]


@dataclass(frozen=True)
class Quantized:
    """All quantized tensors, by the names of the weights."""

    rows: dict[str, QuantizedRows]
    switches: dict[str, QuantizedSwitches]


def from_bits(bits: UInt8[Tensor, "bytes"], count: int) -> Bool[Tensor, "count"]:
    """Return the first `count` switches from packed bytes."""
    return torch.from_numpy(np.unpackbits(bits.numpy(), count=count, bitorder="little")).bool()


def dequantized(quantized: Mapping[str, Any], where: str) -> dict[str, Tensor]:
    """Return the tensors that quantized weights represent; the caller that loads them compares them with a template.

    Args:
        quantized: as `Quantized` describes it.
        where: the file, for messages.

    Raises:
        Mismatch: its parts do not fit each other.
        InputError: it would take more memory than the budget allows.
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


def _table(table: QuantizedRows, name: str) -> Tensor:
    width = table.shape[1] if len(table.shape) == 2 else 1
    count = math.prod(table.shape) // max(1, width)
    if table.values.shape[1:] != (width,) or table.means.shape != (len(table.starts), width):
        raise Mismatch(name, f"has rows of {tuple(table.values.shape)} in a table of {table.shape}")
    kept = torch.ones(count, dtype=torch.bool) if table.kept is None else from_bits(table.kept, count)
    block = block_of(table.starts, count)
    rows = table.means[block]
    rows[kept] = table.values.float() * table.scales[block[kept], None]
    return rows.view(table.shape)


def block_of(starts: Sequence[int], count: int) -> Int[Tensor, "rows"]:
    """Return the index of each row's block, for blocks that begin at `starts`."""
    sizes = torch.tensor([b - a for a, b in zip(starts, [*starts[1:], count], strict=True)])
    return torch.repeat_interleave(torch.arange(len(starts)), sizes)

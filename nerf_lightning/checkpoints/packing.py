"""Weights that a checkpoint holds in fewer bytes: tables as smaller numbers, rows left out, switches as bits.

What is read back are the tensors that a model loads, in float32. The record is tensors, numbers and words alone, and
how large it may become in memory is held to a budget before anything is made (`budgets.unpacked_bytes`).
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from nerf_lightning.files.budgets import allowed, require_within
from nerf_lightning.files.schema import Choice, Description, Many, Maybe, Named, Numbers, Record, Text, Unfit, Whole

NumberType = Literal["float32", "float16", "int8"]
TYPES: dict[NumberType, torch.dtype] = {"float32": torch.float32, "float16": torch.float16, "int8": torch.int8}
SWITCHES = {"bool": torch.bool, "uint8": torch.uint8}
LARGEST_INT8 = 127
MOST_BLOCKS = 1 << 10


def pack_rows(
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


def pack_switches(switches: Tensor) -> dict[str, Any]:
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


def packed_format() -> Record:
    """Return what a checkpoint says of its packed weights; `unpacked` asks what no single key can answer."""
    name = Text(500, r"model\..+")
    shape = Many(Whole(1, 1 << 40), 8, least=1)
    number = Numbers(dtypes=tuple(TYPES.values()))
    bits = Numbers(dtypes=(torch.uint8,))
    rows: dict[str, Description] = {
        "shape": shape,
        "starts": Many(Whole(), MOST_BLOCKS, least=1),
        "kept": Maybe(bits),
        "values": number,
        "scales": Numbers(),
        "means": Numbers(),
    }
    switches: dict[str, Description] = {"shape": shape, "type": Choice(tuple(SWITCHES)), "bits": bits}
    return Record({"rows": Named(name, Record(rows), 1000), "switches": Named(name, Record(switches), 1000)})


def unpacked(packed: Mapping[str, Any], where: str) -> dict[str, Tensor]:
    """Return the tensors that a record of packed weights stands for.

    Args:
        packed: as `packed_format` describes it.
        where: the file, for messages.

    Raises:
        Unfit: its parts do not fit each other.
        InputError: it would take more memory than a person has agreed to.
    """
    _require_memory(packed, where)
    rows = {name: _table(table, f"packed.rows.{name}") for name, table in packed["rows"].items()}
    switches = {name: _switches(each, f"packed.switches.{name}") for name, each in packed["switches"].items()}
    return rows | switches


def _require_memory(packed: Mapping[str, Any], where: str) -> None:
    sizes = [4 * math.prod(table["shape"]) for table in packed["rows"].values()]
    sizes += [math.prod(each["shape"]) for each in packed["switches"].values()]
    if sum(sizes) > allowed().unpacked_bytes:
        require_within("unpacked_bytes", sum(sizes), where, "bytes of packed weights, once they are unpacked")


def _table(table: Mapping[str, Any], place: str) -> Tensor:
    values, shape, starts, means = table["values"], table["shape"], table["starts"], table["means"]
    if values.ndim != 2 or values.shape[1] != (shape[1] if len(shape) == 2 else 1):
        raise Unfit(f"{place}.values", f"has the shape {tuple(values.shape)}, in a table of {shape}")
    count = math.prod(shape) // values.shape[1]
    if starts[0] != 0 or any(b <= a for a, b in zip(starts, [*starts[1:], count], strict=True)):
        raise Unfit(f"{place}.starts", "does not ascend from 0 within the table")
    if table["scales"].shape != (len(starts),) or means.shape != (len(starts), values.shape[1]):
        raise Unfit(place, f"has not one scale and one mean for each of {len(starts)} blocks")
    kept = torch.ones(count, dtype=torch.bool)
    if table["kept"] is not None:
        kept = _switches({"bits": table["kept"], "shape": [count], "type": "bool"}, f"{place}.kept")
    if int(kept.sum()) != values.shape[0]:
        raise Unfit(f"{place}.values", f"has {values.shape[0]:,} rows, where {int(kept.sum()):,} are kept")
    block = _block_of(starts, count)
    rows = means[block]
    rows[kept] = values.float() * table["scales"][block[kept], None]
    if not bool(torch.isfinite(rows).all()):
        raise Unfit(f"{place}.scales", "makes infinity of numbers")
    return rows.view(shape)


def _switches(each: Mapping[str, Any], place: str) -> Tensor:
    count = math.prod(each["shape"])
    if each["bits"].shape != (-(-count // 8),):
        raise Unfit(place, f"has not one bit for each of {count:,} switches")
    return from_bits(each["bits"], count).to(SWITCHES[each["type"]]).view(each["shape"])


def _block_of(starts: Sequence[int], count: int) -> Tensor:
    sizes = torch.tensor([b - a for a, b in zip(starts, [*starts[1:], count], strict=True)])
    return torch.repeat_interleave(torch.arange(len(starts)), sizes)

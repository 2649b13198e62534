"""Quantize the tensors of a checkpoint; `checkpoints/quantization.py` reads them back."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from nerf_lightning.checkpoints.quantization import SWITCHES, block_of

NumberType = Literal["float32", "float16", "int8"]
TYPES: dict[NumberType, torch.dtype] = {"float32": torch.float32, "float16": torch.float16, "int8": torch.int8}
LARGEST_INT8 = 127


def quantize_rows(
    table: Float[Tensor, "..."],
    number: NumberType,
    starts: Sequence[int] = (0,),
    mask: Bool[Tensor, "rows"] | None = None,
) -> dict[str, Any]:
    """Return a quantized table: int8 is in units of its block's largest magnitude over 127.

    Args:
        table: rows of features along the last axis; with more than two axes, each number is a row.
        number: the type in which its numbers are stored.
        starts: the first row of each of its blocks (a hash grid's levels).
        mask: the rows to keep; the others are restored as the mean of their block's kept rows. None: all.
    """
    rows = table.detach().float().cpu()
    rows = rows if rows.ndim == 2 else rows.reshape(-1, 1)
    mask = torch.ones(rows.shape[0], dtype=torch.bool) if mask is None else mask
    ends = [*starts[1:], rows.shape[0]]
    blocks = [(rows[a:b][mask[a:b]], rows[a:b][~mask[a:b]]) for a, b in zip(starts, ends, strict=True)]
    largest = torch.stack([inside.abs().max() if inside.numel() else torch.tensor(0.0) for inside, _ in blocks])
    scales = torch.where(largest > 0, largest / LARGEST_INT8, 1.0) if number == "int8" else torch.ones_like(largest)
    values = rows[mask] / scales[block_of(starts, rows.shape[0])[mask], None]
    return {
        "shape": list(table.shape),
        "starts": list(starts),
        "kept": None if bool(mask.all()) else to_bits(mask),
        "values": (values.round() if number == "int8" else values).to(TYPES[number]),
        "scales": scales,
        "means": torch.stack([left.sum(0) / max(1, left.shape[0]) for _, left in blocks]),
    }


def quantize_switches(switches: Tensor) -> dict[str, Any]:
    """Return a quantized tensor of zeros and ones, of type bool or uint8."""
    kind = next(name for name, dtype in SWITCHES.items() if dtype == switches.dtype)
    return {"shape": list(switches.shape), "type": kind, "bits": to_bits(switches.flatten().bool().cpu())}


def to_bits(switches: Bool[Tensor, "n"]) -> UInt8[Tensor, "bytes"]:
    """Return switches as bytes, the first in the lowest bit.

    >>> to_bits(torch.tensor([True, False, True, False, False, False, False, False, True])).tolist()
    [5, 1]
    """
    return torch.from_numpy(np.packbits(switches.numpy(), bitorder="little"))

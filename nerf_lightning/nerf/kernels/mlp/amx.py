"""Products of bfloat16 matrices with AMX: tiles of 16 rows of 64 bytes, on Intel servers since Sapphire Rapids.

One instruction multiplies two tiles: 8,192 products, where one of AVX512-BF16 has 32. Sums are float32. Linux lets a
process use the tiles once it has requested them, which torch does.

Addresses and words are as in `vectors.py`.
"""

import struct
import sys
from typing import Any

import numpy as np
import torch
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from nerf_lightning.nerf.kernels.mlp.vectors import ADDRESS, WORDS, pointer_to

KIND = np.int64(0)
"""The kind of words that hold two bfloat16 numbers and are multiplied by tiles."""
TILE = 16
"""Rows of a tile, and words of each."""
# Palette 1; from byte 16 on, the bytes per row of each of the eight tiles; from byte 48 on, the number of rows.
CONFIG = struct.pack("<BB14x8H16x8B8x", 1, 0, *[64] * 8, *[TILE] * 8)
# Tiles 0 to 3 hold sums, 4 and 5 rows of x, 6 and 7 columns of w.
X, W = 4, 6


def is_allowed() -> bool:
    """Request the tiles, and return whether this process may use them."""
    try:
        return sys.platform == "linux" and bool(torch.cpu._init_amx())
    except (AttributeError, RuntimeError):  # an older torch, or a CPU unknown to it
        return False


def _say(builder: Any, text: str, *operands: Any) -> None:
    """Emit an instruction that may read and write memory, and is not reordered among others that do."""
    kind = ir.FunctionType(ir.VoidType(), [each.type for each in operands])
    constraints = ",".join(["r"] * len(operands) + ["~{memory}"])
    builder.call(ir.InlineAsm(kind, text, constraints, side_effect=True), operands)


@intrinsic
def is_tiled(context: Any, kind: Any) -> Any:
    """Return whether tiles multiply numbers of a kind."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return ir.Constant(ir.IntType(1), kind == types.int64)

    return types.boolean(kind), code


@intrinsic
def open_tiles(context: Any, kind: Any) -> Any:
    """Configure this thread's tiles."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        if kind == types.int64:
            config = ir.Constant(ir.ArrayType(ir.IntType(8), len(CONFIG)), bytearray(CONFIG))
            at = builder.ptrtoint(cgutils.global_constant(builder.module, "tiles", config), ir.IntType(64))
            _say(builder, "ldtilecfg ($0)", at)
        return context.get_dummy_value()

    return types.void(kind), code


@intrinsic
def close_tiles(context: Any, kind: Any) -> Any:
    """Release this thread's tiles, which other code configures differently."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        if kind == types.int64:
            _say(builder, "tilerelease")
        return context.get_dummy_value()

    return types.void(kind), code


@intrinsic(prefer_literal=True)
def multiply_tiles(
    context: Any, kind: Any, rows: Any, columns: Any, x: Any, next_row: Any, w: Any, y: Any, row: Any, words: Any,
    adds: Any,
) -> Any:  # fmt: skip
    """y[r, c] = sum over k of x[r, k] w[k, c], as `vectors.multiply_block`, for literal `rows` x `columns` tiles.

    The words of a row of x are contiguous, and their number is a multiple of 16.
    """
    across, down = range(columns.literal_value), range(rows.literal_value)

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        x, next_row, w, y, row, words, adds = arguments[3:]
        if kind != types.int64:
            return context.get_dummy_value()

        def rows_on(address: Any, stride: Any, tiles: int) -> Any:
            return builder.add(address, builder.mul(stride, stride.type(TILE * tiles)))

        sums = {(r, c): builder.add(rows_on(y, row, r), y.type(64 * c)) for r in down for c in across}
        with builder.if_else(builder.icmp_signed("!=", adds, adds.type(0))) as (goes_on, begins):
            with goes_on:
                for (r, c), at in sums.items():
                    _say(builder, f"tileloadd ($0,$1,1), %tmm{2 * r + c}", at, row)
            with begins:
                for r, c in sums:
                    _say(builder, f"tilezero %tmm{2 * r + c}")
        with cgutils.for_range(builder, builder.sdiv(words, words.type(TILE))) as loop:
            from_w = builder.add(w, builder.mul(builder.mul(loop.index, row), row.type(TILE)))
            from_x = builder.add(x, builder.mul(loop.index, x.type(64)))
            for c in across:
                _say(builder, f"tileloadd ($0,$1,1), %tmm{W + c}", builder.add(from_w, w.type(64 * c)), row)
            for r in down:
                _say(builder, f"tileloadd ($0,$1,1), %tmm{X + r}", rows_on(from_x, next_row, r), next_row)
                for c in across:
                    _say(builder, f"tdpbf16ps %tmm{W + c}, %tmm{X + r}, %tmm{2 * r + c}")
        for (r, c), at in sums.items():
            _say(builder, f"tilestored %tmm{2 * r + c}, ($0,$1,1)", at, row)
        return context.get_dummy_value()

    return types.void(kind, rows, columns, *[ADDRESS] * 7), code


@intrinsic
def turn_words(context: Any, source: Any, next_source: Any, target: Any, next_target: Any) -> Any:
    """Write the transpose of 16 rows of 16 words; the rows may be any number of bytes apart."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        source, next_source, target, next_target = arguments

        def row(address: Any, stride: Any, r: int) -> Any:
            return pointer_to(builder, builder.add(address, builder.mul(stride, stride.type(r))), WORDS)

        rows = [builder.load(row(source, next_source, r), align=4) for r in range(TILE)]
        for step in (1, 2, 4, 8):  # swap blocks of this many rows and words across the diagonal
            kept = [lane if not lane & step else lane - step + TILE for lane in range(TILE)]
            moved = [lane + step if not lane & step else lane + TILE for lane in range(TILE)]
            for r in range(TILE):
                if not r & step:
                    pair = rows[r], rows[r + step]
                    rows[r], rows[r + step] = (
                        builder.shuffle_vector(*pair, ir.Constant(WORDS, order)) for order in (kept, moved)
                    )
        for r in range(TILE):
            builder.store(rows[r], row(target, next_target, r), align=4)
        return context.get_dummy_value()

    return types.void(*[ADDRESS] * 4), code

"""Vectors of 16 numbers for numba: products, roundings and pairs in bfloat16, by the CPU's own instructions.

LLVM is handed the instructions of AVX512-BF16 as they are, so no compiler is needed; a CPU without them must not come
here. Addresses are whole numbers of bytes; a word is an int32 that holds two bfloat16 numbers, the first in its lower
half.
"""

from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

llvm.initialize_native_asmparser()  # else LLVM refuses instructions that are written out

LANES = 16
WORD, FLOATS, WORDS, HALVES = (
    ir.IntType(32),
    ir.VectorType(ir.FloatType(), LANES),
    ir.VectorType(ir.IntType(32), LANES),
    ir.VectorType(ir.IntType(16), LANES),
)
ADDRESS = types.int64
PRODUCT = ("vdpbf16ps $3, $2, $0", "=v,0,v,v")
ROUND = ("vcvtneps2bf16 $1, $0", "=v,v")


def _at(builder: Any, address: Any, kind: Any, byte: Any = None) -> Any:
    """A pointer to what stands at an address, so many bytes on."""
    return builder.inttoptr(address if byte is None else builder.add(address, byte), kind.as_pointer())


def _times(builder: Any, number: Any, factor: int) -> Any:
    return builder.mul(number, ir.Constant(number.type, factor))


@intrinsic(prefer_literal=True)
def multiply_block(
    context: Any, rows: Any, blocks: Any, x: Any, next_row: Any, next_pair: Any, w: Any, y: Any, row: Any, pairs: Any,
    adds: Any,
) -> Any:  # fmt: skip
    """y[r, c] = sum over k of x[r, 2k] w[2k, c] + x[r, 2k + 1] w[2k + 1, c], for some rows and 16 `blocks` columns.

    Args:
        context: numba's.
        rows: how many, a literal.
        blocks: of 16 columns, a literal.
        x: address of words.
        next_row: bytes from row to row of x.
        next_pair: bytes from pair to pair of x.
        w: address of words, each two rows of one column.
        y: address of float32.
        row: bytes from pair to pair of w, and from row to row of y.
        pairs: how many are summed.
        adds: 1 adds to what stands in y, 0 overwrites it.
    """
    count, width = rows.literal_value, blocks.literal_value

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        x, next_row, next_pair, w, y, row, pairs, adds = arguments[2:]
        dot = ir.InlineAsm(ir.FunctionType(FLOATS, [FLOATS, WORDS, WORDS]), *PRODUCT)
        places = [
            [_at(builder, y, FLOATS, builder.add(_times(builder, row, r), row.type(64 * b))) for b in range(width)]
            for r in range(count)
        ]
        sums = [[cgutils.alloca_once(builder, FLOATS) for _ in range(width)] for _ in range(count)]
        goes_on, zeros = builder.icmp_signed("!=", adds, adds.type(0)), ir.Constant(FLOATS, [0.0] * LANES)
        for r in range(count):
            for b in range(width):
                builder.store(builder.select(goes_on, builder.load(places[r][b], align=4), zeros), sums[r][b])
        undefined, lanes = ir.Constant(WORDS, ir.Undefined), ir.Constant(WORDS, [0] * LANES)
        with cgutils.for_range(builder, pairs) as loop:
            from_w = builder.add(w, builder.mul(loop.index, row))
            from_x = builder.add(x, builder.mul(loop.index, next_pair))
            columns = [builder.load(_at(builder, from_w, WORDS, w.type(64 * b)), align=4) for b in range(width)]
            for r in range(count):
                pair = builder.load(_at(builder, from_x, WORD, _times(builder, next_row, r)), align=4)
                spread = builder.shuffle_vector(builder.insert_element(undefined, pair, WORD(0)), undefined, lanes)
                for b in range(width):
                    builder.store(builder.call(dot, [builder.load(sums[r][b]), spread, columns[b]]), sums[r][b])
        for r in range(count):
            for b in range(width):
                builder.store(builder.load(sums[r][b]), places[r][b], align=4)
        return context.get_dummy_value()

    return types.void(rows, blocks, *[ADDRESS] * 8), code


def _rounded(builder: Any, numbers: Any) -> Any:
    return builder.call(ir.InlineAsm(ir.FunctionType(HALVES, [FLOATS]), *ROUND), [numbers])


@intrinsic
def round_vector(context: Any, source: Any, target: Any) -> Any:
    """Round 16 float32 to bfloat16."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        numbers = builder.load(_at(builder, arguments[0], FLOATS), align=4)
        builder.store(_rounded(builder, numbers), _at(builder, arguments[1], HALVES), align=4)
        return context.get_dummy_value()

    return types.void(ADDRESS, ADDRESS), code


@intrinsic
def round_positive(context: Any, source: Any, target: Any) -> Any:
    """Round 16 float32 to bfloat16, the negative ones to 0."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        numbers = builder.load(_at(builder, arguments[0], FLOATS), align=4)
        zeros = ir.Constant(FLOATS, [0.0] * LANES)
        negative = builder.fcmp_ordered("<", numbers, zeros)  # what is not a number stays that
        positive = builder.select(negative, zeros, numbers)
        builder.store(_rounded(builder, positive), _at(builder, arguments[1], HALVES), align=4)
        return context.get_dummy_value()

    return types.void(ADDRESS, ADDRESS), code


@intrinsic
def round_where_on(context: Any, source: Any, active: Any, target: Any) -> Any:
    """Round 16 float32 to bfloat16, those to 0 where 16 bfloat16 numbers are 0."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        numbers = _rounded(builder, builder.load(_at(builder, arguments[0], FLOATS), align=4))
        active = builder.load(_at(builder, arguments[1], HALVES), align=4)
        none = ir.Constant(HALVES, [0] * LANES)
        kept = builder.select(builder.icmp_unsigned("==", active, none), none, numbers)
        builder.store(kept, _at(builder, arguments[2], HALVES), align=4)
        return context.get_dummy_value()

    return types.void(ADDRESS, ADDRESS, ADDRESS), code


@intrinsic
def pair_rows(context: Any, upper: Any, lower: Any, target: Any) -> Any:
    """Write 16 words, each a number of one row and that below it, from 16 bfloat16 numbers of each."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        rows = [builder.load(_at(builder, address, HALVES), align=4) for address in arguments[:2]]
        order = ir.Constant(
            ir.VectorType(ir.IntType(32), 2 * LANES), [n // 2 + LANES * (n % 2) for n in range(2 * LANES)]
        )
        pairs = builder.shuffle_vector(*rows, order)
        both = ir.VectorType(ir.IntType(16), 2 * LANES)
        builder.store(pairs, _at(builder, arguments[2], both), align=4)
        return context.get_dummy_value()

    return types.void(ADDRESS, ADDRESS, ADDRESS), code

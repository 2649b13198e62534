"""Vectors of 16 numbers for numba: products, and the operations between layers, in float32 or bfloat16.

LLVM lowers the vectors to what the CPU has, so no compiler is needed. For bfloat16 it is given the instructions of
AVX512-BF16 directly, which the CPU must support.

Addresses are integers, in bytes. A word has four bytes: one float32, or two bfloat16 numbers, the first in its lower
half. The first argument of most functions, `kind`, is a number of numba's type for words of float32 (np.float32(0)) or
of bfloat16 (np.int32(0)): its type alone selects one of two implementations.
"""

from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

llvm.initialize_native_asmparser()  # else LLVM refuses instructions that are written out

LANES = 16
WORD, FLOAT, FLOATS, WORDS, HALVES = (
    ir.IntType(32),
    ir.FloatType(),
    ir.VectorType(ir.FloatType(), LANES),
    ir.VectorType(ir.IntType(32), LANES),
    ir.VectorType(ir.IntType(16), LANES),
)
ADDRESS = types.int64
PRODUCT = ("vdpbf16ps $3, $2, $0", "=v,0,v,v")
ROUND = ("vcvtneps2bf16 $1, $0", "=v,v")


def pointer_to(builder: Any, address: Any, kind: Any, byte: Any = None) -> Any:
    """Return a pointer to an address, offset by `byte` bytes."""
    return builder.inttoptr(address if byte is None else builder.add(address, byte), kind.as_pointer())


def _times(builder: Any, number: Any, factor: int) -> Any:
    return builder.mul(number, ir.Constant(number.type, factor))


def _is_bfloat16(kind: Any) -> bool:
    return isinstance(kind, types.Integer)


@intrinsic
def bytes_of(context: Any, kind: Any) -> Any:
    """Return the number of bytes of a number."""
    size = 2 if _is_bfloat16(kind) else 4

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return ir.Constant(ir.IntType(64), size)

    return types.int64(kind), code


@intrinsic(prefer_literal=True)
def multiply_block(
    context: Any, kind: Any, rows: Any, blocks: Any, x: Any, next_row: Any, next_word: Any, w: Any, y: Any, row: Any,
    words: Any, adds: Any,
) -> Any:  # fmt: skip
    """y[r, c] = sum over k of x[r, k] w[k, c], for some rows and 16 `blocks` columns; k goes over words.

    Args:
        context: numba's.
        kind: kind of the words.
        rows: number of rows, a literal.
        blocks: number of blocks of 16 columns, a literal.
        x: address of words.
        next_row: bytes between rows of x.
        next_word: bytes between words of x.
        w: address of words, each of one column; in bfloat16, of two rows.
        y: address of float32 numbers.
        row: bytes between words of w, and between rows of y.
        words: number of words that are summed.
        adds: 1 adds to y, 0 overwrites it.
    """
    count, width, bfloat16 = rows.literal_value, blocks.literal_value, _is_bfloat16(kind)
    number, numbers = (WORD, WORDS) if bfloat16 else (FLOAT, FLOATS)

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        x, next_row, next_word, w, y, row, words, adds = arguments[3:]
        if bfloat16:
            dot = ir.InlineAsm(ir.FunctionType(FLOATS, [FLOATS, WORDS, WORDS]), *PRODUCT)
        else:
            three = ir.FunctionType(FLOATS, [FLOATS, FLOATS, FLOATS])
            fused = cgutils.get_or_insert_function(builder.module, three, "llvm.fmuladd.v16f32")
        addresses = [
            [
                pointer_to(builder, y, FLOATS, builder.add(_times(builder, row, r), row.type(64 * b)))
                for b in range(width)
            ]
            for r in range(count)
        ]
        sums = [[cgutils.alloca_once(builder, FLOATS) for _ in range(width)] for _ in range(count)]
        goes_on, zeros = builder.icmp_signed("!=", adds, adds.type(0)), ir.Constant(FLOATS, [0.0] * LANES)
        for r in range(count):
            for b in range(width):
                builder.store(builder.select(goes_on, builder.load(addresses[r][b], align=4), zeros), sums[r][b])
        undefined, lanes = ir.Constant(numbers, ir.Undefined), ir.Constant(WORDS, [0] * LANES)
        with cgutils.for_range(builder, words) as loop:
            from_w = builder.add(w, builder.mul(loop.index, row))
            from_x = builder.add(x, builder.mul(loop.index, next_word))
            columns = [
                builder.load(pointer_to(builder, from_w, numbers, w.type(64 * b)), align=4) for b in range(width)
            ]
            for r in range(count):
                one = builder.load(pointer_to(builder, from_x, number, _times(builder, next_row, r)), align=4)
                spread = builder.shuffle_vector(builder.insert_element(undefined, one, WORD(0)), undefined, lanes)
                for b in range(width):
                    before = builder.load(sums[r][b])
                    after = (
                        builder.call(dot, [before, spread, columns[b]])
                        if bfloat16
                        else builder.call(fused, [spread, columns[b], before])
                    )
                    builder.store(after, sums[r][b])
        for r in range(count):
            for b in range(width):
                builder.store(builder.load(sums[r][b]), addresses[r][b], align=4)
        return context.get_dummy_value()

    return types.void(kind, rows, blocks, *[ADDRESS] * 8), code


def _write(builder: Any, kind: Any, numbers: Any, address: Any) -> None:
    """Write 16 float32 numbers as numbers of a kind."""
    if _is_bfloat16(kind):
        rounded = builder.call(ir.InlineAsm(ir.FunctionType(HALVES, [FLOATS]), *ROUND), [numbers])
        builder.store(rounded, pointer_to(builder, address, HALVES), align=4)
    else:
        builder.store(numbers, pointer_to(builder, address, FLOATS), align=4)


@intrinsic
def round_vector(context: Any, kind: Any, source: Any, target: Any) -> Any:
    """Round 16 float32 numbers to a kind."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        _write(builder, kind, builder.load(pointer_to(builder, arguments[1], FLOATS), align=4), arguments[2])
        return context.get_dummy_value()

    return types.void(kind, ADDRESS, ADDRESS), code


@intrinsic
def round_positive(context: Any, kind: Any, source: Any, target: Any) -> Any:
    """Round 16 float32 numbers to a kind, negative ones to 0."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        numbers = builder.load(pointer_to(builder, arguments[1], FLOATS), align=4)
        zeros = ir.Constant(FLOATS, [0.0] * LANES)
        negative = builder.fcmp_ordered("<", numbers, zeros)  # NaN stays NaN
        _write(builder, kind, builder.select(negative, zeros, numbers), arguments[2])
        return context.get_dummy_value()

    return types.void(kind, ADDRESS, ADDRESS), code


@intrinsic
def round_where_on(context: Any, kind: Any, source: Any, active: Any, target: Any) -> Any:
    """Round 16 float32 numbers to a kind, to 0 where 16 others of that kind are 0."""
    lanes = HALVES if _is_bfloat16(kind) else WORDS

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        numbers = builder.load(pointer_to(builder, arguments[1], FLOATS), align=4)
        active = builder.load(pointer_to(builder, arguments[2], lanes), align=4)
        off = builder.icmp_unsigned("==", active, ir.Constant(lanes, [0] * LANES))
        _write(builder, kind, builder.select(off, ir.Constant(FLOATS, [0.0] * LANES), numbers), arguments[3])
        return context.get_dummy_value()

    return types.void(kind, ADDRESS, ADDRESS, ADDRESS), code


@intrinsic
def pair_rows(context: Any, upper: Any, lower: Any, target: Any) -> Any:
    """Write 16 words, each a number of one row and the one below it, from 16 bfloat16 numbers of each row."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        rows = [builder.load(pointer_to(builder, address, HALVES), align=4) for address in arguments[:2]]
        order = ir.Constant(
            ir.VectorType(ir.IntType(32), 2 * LANES), [n // 2 + LANES * (n % 2) for n in range(2 * LANES)]
        )
        pairs = builder.shuffle_vector(*rows, order)
        both = ir.VectorType(ir.IntType(16), 2 * LANES)
        builder.store(pairs, pointer_to(builder, arguments[2], both), align=4)
        return context.get_dummy_value()

    return types.void(ADDRESS, ADDRESS, ADDRESS), code

"""The MLP for the CPU: a few rows at a time go through all layers, in the cache.

The time is usually lost not in arithmetic but between layers: a framework writes, casts and rereads what stays here in
128 rows of activations. Products are of float32 numbers or, on CPUs with AVX512-BF16, exact ones of bfloat16 numbers,
depending on the weights' dtype. Sums are float32. With AMX, tiles multiply the bfloat16 numbers.

The last layer's width is padded to whole vectors. Words and kinds are as in `vectors.py` and `amx.py`.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, no_type_check

import llvmlite.binding as llvm
import numba
import numpy as np
import torch
from numba import njit
from torch import Tensor

from nerf_lightning.nerf.kernels.mlp import amx
from nerf_lightning.nerf.kernels.mlp.amx import TILE, close_tiles, is_tiled, multiply_tiles, open_tiles, turn_words
from nerf_lightning.nerf.kernels.mlp.vectors import (
    LANES,
    bytes_of,
    multiply_block,
    pair_rows,
    round_positive,
    round_vector,
    round_where_on,
)
from nerf_lightning.nerf.kernels.threads import in_parallel
from nerf_lightning.nerf.matmul_precision import cpu_multiplies_bfloat16, tiles_of_rows

ROWS = 128
"""Number of rows that go through all layers together."""
CPU = {} if numba.config.CPU_NAME else llvm.get_host_cpu_features()  # type: ignore[attr-defined]
"""LLVM's features of this CPU; empty if numba is set to compile for another."""
KINDS: dict[torch.dtype, Any] = {
    torch.float32: np.float32(0),
    torch.bfloat16: amx.KIND if CPU.get("amx-bf16") and amx.is_allowed() else np.int32(0),
}
"""The kind that selects, for each dtype, the numbers in a word and the instructions that multiply them."""
WIDE = bool(CPU.get("avx512f"))
"""Whether there are 32 full-width vector registers."""


def takes(weights: Sequence[Tensor], dtype: torch.dtype, pads: bool = False) -> bool:
    """Return whether the kernels support an MLP with products of a dtype: its inputs must be whole vectors.

    Args:
        weights: weights of all layers.
        dtype: float32 or bfloat16.
        pads: whether the caller pads the first layer's inputs with zeros.
    """
    return dtype in dtypes() and all(weight.shape[1] % LANES == 0 for weight in weights[1 if pads else 0 :])


def dtypes() -> list[torch.dtype]:
    """Return the supported dtypes of products: bfloat16 only if LLVM, too, knows this CPU's instructions.

    If it does not, it would abort the program.
    """
    return [torch.float32, torch.bfloat16] if CPU.get("avx512bf16") and cpu_multiplies_bfloat16() else [torch.float32]


def forward(points: Tensor, weights: Sequence[Tensor], keep: bool) -> tuple[Tensor, Tensor]:
    """Return the outputs, and the inputs of all layers if they are kept.

    Args:
        points: inputs of the first layer.
        weights: float32 or bfloat16, the dtype of the products.
        keep: whether a backward pass follows.
    """
    points, widths, kind = points.float().contiguous(), padded_widths(weights), KINDS[weights[0].dtype]
    rows = points.shape[0]
    packed, dims = packed_words(weights, widths, transposed=False), np.array(widths)
    padded = -(-rows // ROWS) * ROWS
    out = points.new_empty(padded, weights[-1].shape[0])
    saved = torch.empty(padded if keep else 0, words_of(sum(widths[:-1]), weights[0].dtype), dtype=torch.int32)
    arrays = points.numpy(), packed, dims, out.numpy(), saved.numpy()
    in_parallel(lambda part: _forward(kind, part.start, part.stop, keep, *arrays), tiles_of_rows(rows))
    return out[:rows], saved


def backward(
    grad: Tensor, weights: Sequence[Tensor], saved: Tensor, wants_points: bool
) -> tuple[Tensor | None, list[Tensor]]:
    """Return the gradients of the inputs and of the weights; `saved` is what `forward` returned."""
    widths, kind = padded_widths(weights), KINDS[weights[0].dtype]
    packed, dims = packed_words(weights, widths, transposed=True), np.array(widths)
    rows = grad.shape[0]
    grad_points = torch.empty(saved.shape[0] if wants_points else 0, weights[0].shape[1])
    tiles = tiles_of_rows(rows)
    sums = torch.zeros(len(tiles), sum(a * b for a, b in pairwise(widths)))
    arrays = grad.float().contiguous().numpy(), packed, dims, saved.numpy(), grad_points.numpy()

    def tile(number: int) -> None:
        part = tiles[number]
        _backward(kind, part.start, part.stop, wants_points, *arrays, sums[number].numpy())

    in_parallel(tile, range(len(tiles)))
    return grad_points[:rows] if wants_points else None, unpadded(sums.sum(dim=0), weights, widths)


def unpadded(total: Tensor, weights: Sequence[Tensor], widths: Sequence[int]) -> list[Tensor]:
    """Return the gradients of all layers' weights from one flat array, without padding."""
    grads, offset = [], 0
    for weight, (inner, outer) in zip(weights, pairwise(widths), strict=True):
        of_layer = total[offset : offset + inner * outer].view(outer, inner)
        grads.append(of_layer[: weight.shape[0], : weight.shape[1]])
        offset += inner * outer
    return grads


def trial() -> None:
    """Run the forward kernel once on tiny input; it raises whatever the compiler raises.

    Few trainings need the backward one, since whole-ray kernels have their own.
    """
    points, weights = torch.ones(3, 16), [torch.ones(16, 16), torch.ones(3, 16)]
    for dtype in dtypes():
        forward(points, [weight.to(dtype) for weight in weights], keep=False)


def padded_widths(weights: Sequence[Tensor]) -> list[int]:
    """Return the widths of all layers' inputs and of the output, padded to whole vectors."""
    widths = [weights[0].shape[1], *(weight.shape[0] for weight in weights)]
    return [-(-width // LANES) * LANES for width in widths]


def words_of(numbers: int, dtype: torch.dtype) -> int:
    """Return how many words `numbers` numbers take."""
    return numbers // 2 if dtype == torch.bfloat16 else numbers


def packed_words(weights: Sequence[Tensor], widths: Sequence[int], transposed: bool) -> np.ndarray:
    """Return the words of all layers: rows of W^T, or of W, layer by layer; in bfloat16, pairs of rows."""
    out, offset = np.empty(words_of(sum(a * b for a, b in pairwise(widths)), weights[0].dtype), np.int32), 0
    for weight, (inner, outer) in zip(weights, pairwise(widths), strict=True):
        padded = np.zeros((outer, inner), np.float32)
        padded[: weight.shape[0], : weight.shape[1]] = weight.detach().float().numpy()
        rows = np.ascontiguousarray(padded if transposed else padded.T)
        end = offset + words_of(rows.size, weight.dtype)
        if weight.dtype == torch.bfloat16:
            _pack(rows, out[offset:end])
        else:
            out[offset:end] = rows.reshape(-1).view(np.int32)
        offset = end
    return out


@njit
@no_type_check
def address(array):
    """Return an array's address. The array lives only while its name is in use: call this in the loop that needs it."""
    return np.int64(array.ctypes.data)


@njit
@no_type_check
def _multiply(kind, x, next_row, next_word, w, y, width, rows, words, adds):
    # All rows of y, `width` numbers long, like those of w. As many sums at once as fit into the registers.
    row, column = 4 * width, 0
    if is_tiled(kind) and next_word == 4 and words % TILE == 0:
        _multiply_by_tiles(kind, x, next_row, w, y, width, rows, words, adds)
        return
    while WIDE and width - column >= 64:
        for r in range(0, rows, 4):
            from_x, into = x + r * next_row, y + r * row + 4 * column
            multiply_block(kind, 4, 4, from_x, next_row, next_word, w + 4 * column, into, row, words, adds)
        column += 64
    while WIDE and width - column >= 32:
        for r in range(0, rows, 8):
            from_x, into = x + r * next_row, y + r * row + 4 * column
            multiply_block(kind, 8, 2, from_x, next_row, next_word, w + 4 * column, into, row, words, adds)
        column += 32
    while WIDE and width - column >= 16:
        for r in range(0, rows, 8):
            from_x, into = x + r * next_row, y + r * row + 4 * column
            multiply_block(kind, 8, 1, from_x, next_row, next_word, w + 4 * column, into, row, words, adds)
        column += 16
    while width - column >= 16:
        for r in range(0, rows, 4):
            from_x, into = x + r * next_row, y + r * row + 4 * column
            multiply_block(kind, 4, 1, from_x, next_row, next_word, w + 4 * column, into, row, words, adds)
        column += 16


@njit
@no_type_check
def _multiply_by_tiles(kind, x, next_row, w, y, width, rows, words, adds):
    row = 4 * width
    for r in range(0, rows, 2 * TILE):
        for c in range(0, width, 2 * TILE):
            from_x, from_w, into = x + r * next_row, w + 4 * c, y + r * row + 4 * c
            is_tall, is_broad = rows - r > TILE, width - c > TILE
            if is_tall and is_broad:
                multiply_tiles(kind, 2, 2, from_x, next_row, from_w, into, row, words, adds)
            elif is_tall:
                multiply_tiles(kind, 2, 1, from_x, next_row, from_w, into, row, words, adds)
            elif is_broad:
                multiply_tiles(kind, 1, 2, from_x, next_row, from_w, into, row, words, adds)
            else:
                multiply_tiles(kind, 1, 1, from_x, next_row, from_w, into, row, words, adds)


@njit(nogil=True, cache=True)
@no_type_check
def _pack(rows, out):
    # Pairs of rows, rounded to bfloat16.
    kind, (count, width) = np.int32(0), rows.shape
    halves = np.empty((2, width), np.int16)
    for r in range(0, count, 2):
        for c in range(0, width, 16):
            at = address(halves) + 2 * c
            round_vector(kind, address(rows) + 4 * (r * width + c), at)
            round_vector(kind, address(rows) + 4 * ((r + 1) * width + c), at + 2 * width)
            pair_rows(at, at + 2 * width, address(out) + 4 * (r // 2 * width + c))


@njit
@no_type_check
def round_rows(kind, source, next_source, target, next_target, rows, width):
    """Round rows of float32 numbers to a kind."""
    size = bytes_of(kind)
    for r in range(rows):
        for c in range(0, width, 16):
            round_vector(kind, source + r * next_source + 4 * c, target + r * next_target + size * c)


@njit
@no_type_check
def _activate(kind, sums, width, target, next_target):
    size = bytes_of(kind)
    for r in range(ROWS):
        for c in range(0, width, 16):
            round_positive(kind, sums + 4 * (r * width + c), target + r * next_target + size * c)


@njit
@no_type_check
def _pass_back(kind, sums, width, inputs, next_input, target):
    size = bytes_of(kind)
    for r in range(ROWS):
        for c in range(0, width, 16):
            at = r * width + c
            round_where_on(kind, sums + 4 * at, inputs + r * next_input + size * c, target + size * at)


@njit
@no_type_check
def _stack_rows(kind, source, next_row, width, target):
    # Contiguous rows, as words that a product sums over.
    if bytes_of(kind) == 4:
        round_rows(kind, source, next_row, target, 4 * width, ROWS, width)
        return
    for r in range(0, ROWS, 2):
        for c in range(0, width, 16):
            at = source + r * next_row + 2 * c
            pair_rows(at, at + next_row, target + 4 * (r // 2 * width + c))


@njit
@no_type_check
def _turn(source, rows, width, target):
    # The transpose of rows of words.
    for r in range(0, rows, TILE):
        for c in range(0, width, TILE):
            turn_words(source + 4 * (r * width + c), 4 * width, target + 4 * (c * rows + r), 4 * rows)


@njit
@no_type_check
def through(kind, x, w, dims, y, into):
    """Send ROWS rows through all layers, and write the output to `into`; x has room for all layers' inputs.

    All rows of the first layer's inputs, which are given, are followed by those of the second's, and so on, so that
    memory is written from beginning to end.
    """
    layers, size = len(dims) - 1, bytes_of(kind)
    open_tiles(kind)
    for layer in range(layers):
        inner, outer = dims[layer], dims[layer + 1]
        last = layer == layers - 1
        _multiply(kind, x, size * inner, 4, w, into if last else y, outer, ROWS, inner * size // 4, 0)
        x, w = x + ROWS * size * inner, w + size * inner * outer
        if not last:
            _activate(kind, y, outer, x, size * outer)
    close_tiles(kind)


@njit
@no_type_check
def back_through(kind, x, w, dims, dy, y, upper, lower, total, wants_inputs, into):
    """Send gradients of ROWS rows back through all layers.

    Args:
        kind: kind of the words.
        x: address of all layers' inputs, as `through` left them.
        w: address of all layers' words, transposed.
        dims: widths of all layers' inputs, and of the output.
        dy: address of the gradients of the output, numbers of the kind, with room for the widest layer's.
        y: address of room for the sums.
        upper: address of room for numbers of the kind.
        lower: the same, for as many.
        total: address of the gradients of the weights, which are accumulated.
        wants_inputs: whether to compute the gradients of the inputs, in float32.
        into: where to write them.
    """
    size, before, numbers = bytes_of(kind), 0, 0
    open_tiles(kind)
    for layer in range(len(dims) - 1):
        before, numbers = before + dims[layer], numbers + dims[layer] * dims[layer + 1]
    for layer in range(len(dims) - 2, -1, -1):
        inner, outer = dims[layer], dims[layer + 1]
        before, numbers = before - inner, numbers - inner * outer
        inputs, words = x + ROWS * size * before, w + size * numbers
        # dW[o, i] = sum over rows of dy[row, o] x[row, i]
        if is_tiled(kind):  # tiles need the summed dimension contiguous
            _stack_rows(kind, dy, size * outer, outer, lower)
            _turn(lower, ROWS * size // 4, outer, upper)
            next_row, next_word = ROWS * size, 4
        else:
            _stack_rows(kind, dy, size * outer, outer, upper)
            next_row, next_word = 4, 4 * outer
        _stack_rows(kind, inputs, size * inner, inner, lower)
        _multiply(kind, upper, next_row, next_word, lower, total + 4 * numbers, inner, outer, ROWS * size // 4, 1)
        if layer:
            _multiply(kind, dy, size * outer, 4, words, y, inner, ROWS, outer * size // 4, 0)
            _pass_back(kind, y, inner, inputs, size * inner, dy)
        elif wants_inputs:
            _multiply(kind, dy, size * outer, 4, words, into, inner, ROWS, outer * size // 4, 0)
    close_tiles(kind)


@njit(nogil=True, cache=True)
@no_type_check
def _forward(kind, first, last, keep, points, packed, dims, out, saved):
    layers, words = len(dims) - 1, dims[:-1].sum() * bytes_of(kind) // 4
    stride, whole = 4 * words, out.shape[1] == dims[layers]
    own = np.zeros((1 if keep else ROWS, words), np.int32)
    sums = np.empty((ROWS, dims.max()), np.float32)
    flat = sums.reshape(-1)
    for start in range(first, last, ROWS):
        count = min(ROWS, last - start)
        x = address(saved) + start * stride if keep else address(own)
        if keep and count < ROWS:
            saved[start : start + ROWS] = 0  # the backward pass sums over whole blocks
        round_rows(
            kind, address(points) + 4 * start * dims[0], 4 * dims[0], x, bytes_of(kind) * dims[0], count, dims[0]
        )
        y = address(sums)
        into = address(out) + 4 * start * dims[layers] if whole else y
        through(kind, x, address(packed), dims, y, into)
        for r in range(0 if whole else count):
            for c in range(out.shape[1]):
                out[start + r, c] = flat[r * dims[layers] + c]


@njit
@no_type_check
def _round_gradient(kind, grad, start, count, width, flat, target):
    if grad.shape[1] == width and count == ROWS:
        source = address(grad) + 4 * start * width
    else:
        source = address(flat)
        flat[: ROWS * width] = 0.0
        for r in range(count):
            for c in range(grad.shape[1]):
                flat[r * width + c] = grad[start + r, c]
    round_rows(kind, source, 4 * width, target, bytes_of(kind) * width, ROWS, width)


@njit(nogil=True, cache=True)
@no_type_check
def _backward(kind, first, last, wants_points, grad, packed, dims, saved, grad_points, grads):
    layers, size, widest = len(dims) - 1, bytes_of(kind), dims.max()
    stride = size * dims[:-1].sum()
    sums, room = np.empty((ROWS, widest), np.float32), np.empty((3, ROWS, widest * size // 4), np.int32)
    flat, next_room = sums.reshape(-1), size * ROWS * widest
    for start in range(first, last, ROWS):
        y, dy = address(sums), address(room)
        _round_gradient(kind, grad, start, min(ROWS, last - start), dims[layers], flat, dy)
        x, into = address(saved) + start * stride, address(grad_points) + 4 * start * dims[0]
        back_through(
            kind, x, address(packed), dims, dy, y, dy + next_room, dy + 2 * next_room, address(grads),
            wants_points, into,
        )  # fmt: skip

"""The perceptron in bfloat16 for CPUs with AVX512-BF16: a few rows at a time go through all layers, in the cache.

What is lost elsewhere is not arithmetic but the way between layers: a framework writes, casts and reads again what here
stays in 128 rows of activations. Products are of bfloat16 numbers and exact; sums are float32.

The last layer's width is padded to whole vectors. A word is an int32 with two bfloat16 numbers.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import no_type_check

import llvmlite.binding as llvm
import numba
import numpy as np
import torch
from numba import njit
from torch import Tensor

from nerf_lightning.nerf.kernels.mlp.vectors import (
    LANES,
    multiply_block,
    pair_rows,
    round_positive,
    round_vector,
    round_where_on,
)
from nerf_lightning.nerf.kernels.threads import in_parallel
from nerf_lightning.nerf.products import tiles_of_rows

COMPILED_WITH = "ab402674"
"""The state of the files from which something is compiled in: numba itself looks at this one alone."""

ROWS = 128
"""So many go through all layers together."""


def takes(widths: Sequence[int]) -> bool:
    """Tell whether the kernels take a perceptron whose layers have inputs of these widths: whole vectors."""
    return all(width % LANES == 0 for width in widths)


def forward(points: Tensor, weights: Sequence[Tensor], keep: bool) -> tuple[Tensor, Tensor]:
    """Return the outputs, and the inputs of all layers where they are to be kept.

    Args:
        points: inputs of the first layer.
        weights: float32.
        keep: whether a backward pass follows.
    """
    points, widths = points.float().contiguous(), padded_widths(weights)
    rows, words = points.shape[0], sum(widths[:-1]) // 2
    packed, dims = packed_words(weights, widths, transposed=False), np.array(widths)
    padded = -(-rows // ROWS) * ROWS
    out = points.new_empty(padded, weights[-1].shape[0])
    kept = torch.empty(padded if keep else 0, words, dtype=torch.int32)
    arrays = points.numpy(), packed, dims, out.numpy(), kept.numpy()
    in_parallel(lambda part: _forward(part.start, part.stop, keep, *arrays), tiles_of_rows(rows))
    return out[:rows], kept


def backward(
    grad: Tensor, weights: Sequence[Tensor], kept: Tensor, wants_points: bool
) -> tuple[Tensor | None, list[Tensor]]:
    """Return the gradients of the inputs and of the weights; `kept` is what `forward` returned."""
    widths = padded_widths(weights)
    packed, dims = packed_words(weights, widths, transposed=True), np.array(widths)
    rows = grad.shape[0]
    grad_points = grad.new_empty(kept.shape[0] if wants_points else 0, weights[0].shape[1])
    tiles = tiles_of_rows(rows)
    sums = torch.zeros(len(tiles), sum(a * b for a, b in pairwise(widths)))
    arrays = grad.float().contiguous().numpy(), packed, dims, kept.numpy(), grad_points.numpy()

    def tile(number: int) -> None:
        part = tiles[number]
        _backward(part.start, part.stop, wants_points, *arrays, sums[number].numpy())

    in_parallel(tile, range(len(tiles)))
    grads, place = [], 0
    total = sums.sum(dim=0)
    for weight, (inner, outer) in zip(weights, pairwise(widths), strict=True):
        grads.append(total[place : place + inner * outer].view(outer, inner)[: weight.shape[0]])
        place += inner * outer
    return grad_points[:rows] if wants_points else None, grads


def trial() -> None:
    """Run every kernel once on next to nothing; it raises whatever their compiler raises.

    Raises:
        RuntimeError: numba compiles for a CPU without these instructions, which LLVM would end the program for.
    """
    require_bfloat16()
    points, weights = torch.ones(3, 16), [torch.ones(16, 16), torch.ones(3, 16)]
    out, kept = forward(points, weights, keep=True)
    backward(out, weights, kept, wants_points=True)


def require_bfloat16() -> None:
    """Look whether LLVM, too, knows of this CPU's instructions.

    Raises:
        RuntimeError: numba compiles for a CPU without them, which LLVM would end the program for.
    """
    if numba.config.CPU_NAME or not llvm.get_host_cpu_features().get("avx512bf16"):  # type: ignore[attr-defined]
        raise RuntimeError("numba does not know that this CPU multiplies bfloat16 (AVX512-BF16)")


def padded_widths(weights: Sequence[Tensor]) -> list[int]:
    """Return the widths of all layers' inputs and of what comes out, in whole vectors."""
    widths = [weights[0].shape[1], *(weight.shape[0] for weight in weights)]
    return [-(-width // LANES) * LANES for width in widths]


def packed_words(weights: Sequence[Tensor], widths: Sequence[int], transposed: bool) -> np.ndarray:
    """Return the words of all layers: pairs of rows of W^T, or of W, one after the other."""
    out = np.empty(sum(a * b for a, b in pairwise(widths)) // 2, np.int32)
    place = 0
    for weight, (inner, outer) in zip(weights, pairwise(widths), strict=True):
        end = place + inner * outer // 2
        _pack(weight.contiguous().numpy(), inner, outer, transposed, out[place:end])
        place = end
    return out


@njit
@no_type_check
def address(array):
    """Return where an array lies. It lives only as long as its name is used: ask for this in the loop that needs it."""
    return np.int64(array.ctypes.data)


@njit
@no_type_check
def _multiply(x, next_row, next_pair, w, y, width, rows, pairs, adds):
    # All rows of y, which are `width` numbers long, as w's are. As many sums at once as the registers hold.
    row, column = 4 * width, 0
    while width - column >= 64:
        for r in range(0, rows, 4):
            from_x, into = x + r * next_row, y + r * row + 4 * column
            multiply_block(4, 4, from_x, next_row, next_pair, w + 4 * column, into, row, pairs, adds)
        column += 64
    while width - column >= 32:
        for r in range(0, rows, 8):
            from_x, into = x + r * next_row, y + r * row + 4 * column
            multiply_block(8, 2, from_x, next_row, next_pair, w + 4 * column, into, row, pairs, adds)
        column += 32
    while width - column >= 16:
        for r in range(0, rows, 8):
            from_x, into = x + r * next_row, y + r * row + 4 * column
            multiply_block(8, 1, from_x, next_row, next_pair, w + 4 * column, into, row, pairs, adds)
        column += 16


@njit(nogil=True, cache=True)
@no_type_check
def _pack(weight, inner, outer, transposed, out):
    numbers, words = np.zeros((outer, inner), np.float32), np.empty((outer, inner // 2), np.int32)
    numbers[: weight.shape[0], : weight.shape[1]] = weight
    for at in range(0, outer * inner, 16):
        round_vector(address(numbers) + 4 * at, address(words) + 2 * at)
    if transposed:
        for o in range(0, outer, 2):
            for i in range(0, inner, 16):
                at = address(words) + 2 * (o * inner + i)
                pair_rows(at, at + 2 * inner, address(out) + 4 * (o // 2 * inner + i))
    else:
        for o in range(outer):
            for pair in range(inner // 2):
                out[pair * outer + o] = words[o, pair]


@njit
@no_type_check
def round_rows(source, next_source, target, next_target, rows, width):
    """Round rows of float32 to words."""
    for r in range(rows):
        for c in range(0, width, 16):
            round_vector(source + r * next_source + 4 * c, target + r * next_target + 2 * c)


@njit
@no_type_check
def _activate(sums, width, target, next_target):
    for r in range(ROWS):
        for c in range(0, width, 16):
            round_positive(sums + 4 * (r * width + c), target + r * next_target + 2 * c)


@njit
@no_type_check
def _pass_back(sums, width, inputs, next_input, target):
    for r in range(ROWS):
        for c in range(0, width, 16):
            at = r * width + c
            round_where_on(sums + 4 * at, inputs + r * next_input + 2 * c, target + 2 * at)


@njit
@no_type_check
def _pair_rows(source, next_row, width, target):
    for r in range(0, ROWS, 2):
        for c in range(0, width, 16):
            at = source + r * next_row + 2 * c
            pair_rows(at, at + next_row, target + 4 * (r // 2 * width + c))


@njit
@no_type_check
def through(x, stride, w, dims, y, into):
    """Send ROWS rows through all layers: words at x, with room for all layers' inputs; the end goes to `into`."""
    layers = len(dims) - 1
    for layer in range(layers):
        inner, outer = dims[layer], dims[layer + 1]
        _multiply(x, stride, 4, w, into if layer == layers - 1 else y, outer, ROWS, inner // 2, 0)
        x, w = x + 2 * inner, w + 2 * inner * outer
        if layer < layers - 1:
            _activate(y, outer, x, stride)


@njit(nogil=True, cache=True)
@no_type_check
def _forward(first, last, keep, points, packed, dims, out, kept):
    layers, words = len(dims) - 1, dims[:-1].sum() // 2
    stride, whole = 4 * words, out.shape[1] == dims[layers]
    own = np.zeros((1 if keep else ROWS, words), np.int32)
    sums = np.empty((ROWS, dims.max()), np.float32)
    flat = sums.reshape(-1)
    for start in range(first, last, ROWS):
        count = min(ROWS, last - start)
        x = address(kept) + start * stride if keep else address(own)
        round_rows(address(points) + 4 * start * dims[0], 4 * dims[0], x, stride, count, dims[0])
        if keep:
            kept[start + count : start + ROWS] = 0  # the sums of the way back go over whole blocks
        y = address(sums)
        into = address(out) + 4 * start * dims[layers] if whole else y
        through(x, stride, address(packed), dims, y, into)
        for r in range(0 if whole else count):
            for c in range(out.shape[1]):
                out[start + r, c] = flat[r * dims[layers] + c]


@njit
@no_type_check
def _round_gradient(grad, start, count, width, flat, target):
    if grad.shape[1] == width and count == ROWS:
        source = address(grad) + 4 * start * width
    else:
        source = address(flat)
        flat[: ROWS * width] = 0.0
        for r in range(count):
            for c in range(grad.shape[1]):
                flat[r * width + c] = grad[start + r, c]
    round_rows(source, 4 * width, target, 2 * width, ROWS, width)


@njit(nogil=True, cache=True)
@no_type_check
def _backward(first, last, wants_points, grad, packed, dims, kept, grad_points, grads):
    layers, stride, widest = len(dims) - 1, 2 * dims[:-1].sum(), dims.max()
    sums, flowing = np.empty((ROWS, widest), np.float32), np.empty((ROWS, widest // 2), np.int32)
    left, right = np.empty((ROWS // 2, widest), np.int32), np.empty((ROWS // 2, widest), np.int32)
    flat, numbers = sums.reshape(-1), (dims[:-1] * dims[1:]).sum()
    for start in range(first, last, ROWS):
        y, dy, upper, lower = address(sums), address(flowing), address(left), address(right)
        _round_gradient(grad, start, min(ROWS, last - start), dims[layers], flat, dy)
        x, w, total = (
            address(kept) + (start + 1) * stride,
            address(packed) + 2 * numbers,
            address(grads) + 4 * numbers,
        )
        for layer in range(layers - 1, -1, -1):
            inner, outer = dims[layer], dims[layer + 1]
            x, w, total = x - 2 * inner, w - 2 * inner * outer, total - 4 * inner * outer
            _pair_rows(dy, 2 * outer, outer, upper)
            _pair_rows(x, stride, inner, lower)
            # dW[o, i] = sum over rows of dy[row, o] x[row, i]
            _multiply(upper, 4, 4 * outer, lower, total, inner, outer, ROWS // 2, 1)
            if layer:
                _multiply(dy, 2 * outer, 4, w, y, inner, ROWS, outer // 2, 0)
                _pass_back(y, inner, x, stride, dy)
            elif wants_points:
                _multiply(dy, 2 * outer, 4, w, address(grad_points) + 4 * start * inner, inner, ROWS, outer // 2, 0)

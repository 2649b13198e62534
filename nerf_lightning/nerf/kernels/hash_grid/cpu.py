"""The hash grid for the CPU. The backward pass goes level by level, so two threads never write the same entry.

`lanes` is a tuple of F zeros: its length is part of the compiled signature, so the loops over features become vectors.
"""

from collections.abc import Sequence
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float
from llvmlite import ir
from numba import njit
from numba.core import cgutils, types
from numba.extending import intrinsic
from torch import Tensor

from nerf_lightning.nerf.kernels.hash_grid.layout import PRIME_Y, PRIME_Z, HashGridLayout, hash_grid_layout
from nerf_lightning.nerf.kernels.threads import in_parallel, over_rows

POINTS = 64
"""Points per block: their cells are found with vector instructions, then their entries are fetched. Finding them one by
one between fetches would keep the processor from prefetching."""
AHEAD = 8
"""A point's entries are prefetched this many points before they are used. A processor by itself looks ahead over two or
three, and would wait most of the time for a level that does not fit into its caches."""
FEATURES = 4
"""Features per level that kernels are compiled for ahead of time; those for other numbers compile on first use."""
NEAR_BYTES = 1 << 18
"""Levels up to this size in bytes are in the caches anyway."""
SPREAD_Y, SPREAD_Z = np.uint32(PRIME_Y), np.uint32(PRIME_Z)
ZERO, ONE = np.float32(0.0), np.float32(1.0)
NONE, NEXT = np.int32(0), np.int32(1)


def forward(
    table: Float[Tensor, "entries features"], points: Float[Tensor, "points 3"], layout: HashGridLayout
) -> Float[Tensor, "points out"]:
    """Return the features."""
    lanes = (0,) * table.shape[1]
    out = torch.empty(points.shape[0], len(layout.resolutions) * len(lanes))
    over_rows(encode, points.shape[0], table.numpy(), points.numpy(), *level_arrays(layout), lanes, out.numpy())
    return out


def add_table_gradient(
    into: Float[Tensor, "entries features"],
    points: Float[Tensor, "points 3"],
    grad: Float[Tensor, "points out"],
    layout: HashGridLayout,
) -> None:
    """Add the gradient with respect to the table to `into`."""
    add_table_gradients(into, [(points, grad)], layout)


def add_table_gradients(
    into: Float[Tensor, "entries features"], contributions: Sequence[tuple[Tensor, Tensor]], layout: HashGridLayout
) -> None:
    """Add several gradients with respect to the table, one after another.

    Args:
        into: the sum, of the table's size.
        contributions: sets of points, `points 3`, each with the gradient of their features, `points out`.
        layout: where the levels' entries are.
    """
    table, of_layout = into.numpy(), (*level_arrays(layout), (0,) * into.shape[1])
    arrays = [(points.numpy(), grad.numpy()) for points, grad in contributions]

    def add(level: int) -> None:
        for points, grad in arrays:
            _add_table_gradient(level, table, points, grad, *of_layout)

    # Fine levels take longest, so they come first.
    in_parallel(add, range(len(layout.resolutions))[::-1])


def point_gradient(
    table: Float[Tensor, "entries features"],
    points: Float[Tensor, "points 3"],
    grad: Float[Tensor, "points out"],
    layout: HashGridLayout,
) -> Float[Tensor, "points 3"]:
    """Return the gradient with respect to the points."""
    out = torch.empty_like(points)
    lanes = (0,) * table.shape[1]
    arrays = (table.numpy(), points.numpy(), grad.numpy(), *level_arrays(layout), lanes, out.numpy())
    over_rows(write_point_gradient, points.shape[0], *arrays)
    return out


def trial() -> None:
    """Run every kernel once on tiny input; it raises whatever the compiler raises."""
    layout, points = hash_grid_layout(2, 6, 2, 8), torch.full((4, 3), 0.3)
    table, grad = torch.zeros(layout.offsets[-1], FEATURES), torch.ones(4, 2 * FEATURES)
    forward(table, points, layout)
    add_table_gradient(table, points, grad, layout)
    point_gradient(table, points, grad, layout)


def level_arrays(layout: HashGridLayout) -> tuple[Any, ...]:
    """Return a layout as arguments of the kernels."""
    resolutions = np.array(layout.resolutions, np.int32)
    hashed = np.array([layout.is_hashed(level) for level in range(len(resolutions))])
    return resolutions, np.array(layout.offsets, np.int64), hashed, np.uint32(layout.table_size - 1)


@njit(fastmath=True)
@no_type_check
def _cell(coordinate, resolution):
    scaled = min(max(coordinate, np.float32(0.0)), ONE) * np.float32(resolution)
    cell = max(min(np.int32(scaled), np.int32(resolution - 1)), NONE)  # for any coordinate
    return cell, np.float32(scaled - np.float32(cell))


@njit(fastmath=True)
@no_type_check
def _corners(x, y, z, resolution, offset, hashed, mask):
    if hashed:
        x0, x1 = np.uint32(x), np.uint32(x + 1)
        y0 = np.uint32(np.uint32(y) * SPREAD_Y)
        y1 = np.uint32(y0 + SPREAD_Y)
        z0 = np.uint32(np.uint32(z) * SPREAD_Z)
        z1 = np.uint32(z0 + SPREAD_Z)
        a, b, c, d = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
        return (
            offset + np.int64((x0 ^ a) & mask),
            offset + np.int64((x1 ^ a) & mask),
            offset + np.int64((x0 ^ b) & mask),
            offset + np.int64((x1 ^ b) & mask),
            offset + np.int64((x0 ^ c) & mask),
            offset + np.int64((x1 ^ c) & mask),
            offset + np.int64((x0 ^ d) & mask),
            offset + np.int64((x1 ^ d) & mask),
        )
    row = np.int64(resolution + 1)
    plane = row * row
    first = offset + np.int64(x) + np.int64(y) * row + np.int64(z) * plane
    above = first + plane
    return first, first + 1, first + row, first + row + 1, above, above + 1, above + row, above + row + 1


@njit(fastmath=True)
@no_type_check
def _weights(x, y, z):
    u, v, w = ONE - x, ONE - y, ONE - z
    a, b, c, d = v * w, y * w, v * z, y * z
    return u * a, x * a, u * b, x * b, u * c, x * c, u * d, x * d


# The values of POINTS points are adjacent, and those of their eight corners' entries and weights follow one another, so
# that the compiler vectorizes these loops. The cell is in the grid for any point.
@njit(fastmath=True)
@no_type_check
def _take_points(points, first, count, p):
    for i in range(POINTS):
        j = first + min(i, count - 1)
        p[i] = min(max(points[j, 0], ZERO), ONE)
        p[POINTS + i] = min(max(points[j, 1], ZERO), ONE)
        p[2 * POINTS + i] = min(max(points[j, 2], ZERO), ONE)


@njit(fastmath=True)
@no_type_check
def _weigh(i, x, y, z, w):
    u, v, t = ONE - x, ONE - y, ONE - z
    a, b, c, d = v * t, y * t, v * z, y * z
    w[i], w[POINTS + i] = u * a, x * a
    w[2 * POINTS + i], w[3 * POINTS + i] = u * b, x * b
    w[4 * POINTS + i], w[5 * POINTS + i] = u * c, x * c
    w[6 * POINTS + i], w[7 * POINTS + i] = u * d, x * d


@njit(fastmath=True)
@no_type_check
def _find_hashed(p, resolution, mask, e, w):
    scale, last, mask = np.float32(resolution), np.int32(resolution - 1), np.int32(mask)
    spread_y, spread_z = np.int32(SPREAD_Y), np.int32(SPREAD_Z)
    for i in range(POINTS):
        sx, sy, sz = p[i] * scale, p[POINTS + i] * scale, p[2 * POINTS + i] * scale
        x0 = max(min(np.int32(sx), last), NONE)
        y, z = max(min(np.int32(sy), last), NONE), max(min(np.int32(sz), last), NONE)
        _weigh(i, sx - np.float32(x0), sy - np.float32(y), sz - np.float32(z), w)
        x1, y0, z0 = np.int32(x0 + NEXT), np.int32(y * spread_y), np.int32(z * spread_z)
        y1, z1 = np.int32(y0 + spread_y), np.int32(z0 + spread_z)
        a, b, c, d = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
        e[i], e[POINTS + i] = (x0 ^ a) & mask, (x1 ^ a) & mask
        e[2 * POINTS + i], e[3 * POINTS + i] = (x0 ^ b) & mask, (x1 ^ b) & mask
        e[4 * POINTS + i], e[5 * POINTS + i] = (x0 ^ c) & mask, (x1 ^ c) & mask
        e[6 * POINTS + i], e[7 * POINTS + i] = (x0 ^ d) & mask, (x1 ^ d) & mask


@njit(fastmath=True)
@no_type_check
def _find_dense(p, resolution, e, w):
    scale, last, row = np.float32(resolution), np.int32(resolution - 1), np.int32(resolution + 1)
    plane = np.int32(row * row)
    for i in range(POINTS):
        sx, sy, sz = p[i] * scale, p[POINTS + i] * scale, p[2 * POINTS + i] * scale
        x = max(min(np.int32(sx), last), NONE)
        y, z = max(min(np.int32(sy), last), NONE), max(min(np.int32(sz), last), NONE)
        _weigh(i, sx - np.float32(x), sy - np.float32(y), sz - np.float32(z), w)
        first = np.int32(x + y * row + z * plane)
        above = np.int32(first + plane)
        e[i], e[POINTS + i], e[2 * POINTS + i], e[3 * POINTS + i] = first, first + NEXT, first + row, first + row + NEXT
        e[4 * POINTS + i], e[5 * POINTS + i] = above, above + NEXT
        e[6 * POINTS + i], e[7 * POINTS + i] = above + row, above + row + NEXT


@njit(fastmath=True)
@no_type_check
def _find(p, resolution, hashed, mask, e, w):
    if hashed:
        _find_hashed(p, resolution, mask, e, w)
    else:
        _find_dense(p, resolution, e, w)


# Two or four features are kept in registers as one vector: written one by one, the compiler must assume that stores and
# loads alias, and the code takes up to seven times as long. An unsigned index needs no test for a negative one.
@njit(fastmath=True)
@no_type_check
def _take_two(table, index, weight, a, b):
    entry = np.uintp(index)
    return a + weight * table[entry, 0], b + weight * table[entry, 1]


@njit(fastmath=True)
@no_type_check
def _give_two(into, index, weight, a, b):
    entry = np.uintp(index)
    p, q = into[entry, 0], into[entry, 1]
    into[entry, 0], into[entry, 1] = p + weight * a, q + weight * b


@njit(fastmath=True)
@no_type_check
def _take(table, index, weight, a, b, c, d):
    entry = np.uintp(index)
    return (
        a + weight * table[entry, 0],
        b + weight * table[entry, 1],
        c + weight * table[entry, 2],
        d + weight * table[entry, 3],
    )


@njit(fastmath=True)
@no_type_check
def _give(into, index, weight, a, b, c, d):
    entry = np.uintp(index)
    p, q, r, s = into[entry, 0], into[entry, 1], into[entry, 2], into[entry, 3]
    into[entry, 0], into[entry, 1] = p + weight * a, q + weight * b
    into[entry, 2], into[entry, 3] = r + weight * c, s + weight * d


@njit(fastmath=True)
@no_type_check
def _gather(table, offset, e, w, i, out, row, column, lanes):
    if len(lanes) == 4:
        a = b = c = d = ZERO
        a, b, c, d = _take(table, offset + e[i], w[i], a, b, c, d)
        a, b, c, d = _take(table, offset + e[POINTS + i], w[POINTS + i], a, b, c, d)
        a, b, c, d = _take(table, offset + e[2 * POINTS + i], w[2 * POINTS + i], a, b, c, d)
        a, b, c, d = _take(table, offset + e[3 * POINTS + i], w[3 * POINTS + i], a, b, c, d)
        a, b, c, d = _take(table, offset + e[4 * POINTS + i], w[4 * POINTS + i], a, b, c, d)
        a, b, c, d = _take(table, offset + e[5 * POINTS + i], w[5 * POINTS + i], a, b, c, d)
        a, b, c, d = _take(table, offset + e[6 * POINTS + i], w[6 * POINTS + i], a, b, c, d)
        a, b, c, d = _take(table, offset + e[7 * POINTS + i], w[7 * POINTS + i], a, b, c, d)
        out[row, column], out[row, column + 1], out[row, column + 2], out[row, column + 3] = a, b, c, d
        return
    if len(lanes) == 2:
        a = b = ZERO
        a, b = _take_two(table, offset + e[i], w[i], a, b)
        a, b = _take_two(table, offset + e[POINTS + i], w[POINTS + i], a, b)
        a, b = _take_two(table, offset + e[2 * POINTS + i], w[2 * POINTS + i], a, b)
        a, b = _take_two(table, offset + e[3 * POINTS + i], w[3 * POINTS + i], a, b)
        a, b = _take_two(table, offset + e[4 * POINTS + i], w[4 * POINTS + i], a, b)
        a, b = _take_two(table, offset + e[5 * POINTS + i], w[5 * POINTS + i], a, b)
        a, b = _take_two(table, offset + e[6 * POINTS + i], w[6 * POINTS + i], a, b)
        a, b = _take_two(table, offset + e[7 * POINTS + i], w[7 * POINTS + i], a, b)
        out[row, column], out[row, column + 1] = a, b
        return
    for f in range(len(lanes)):
        total = ZERO
        for k in range(i, 8 * POINTS, POINTS):
            total += w[k] * table[offset + e[k], f]
        out[row, column + f] = total


@njit(fastmath=True)
@no_type_check
def _scatter(into, offset, e, w, i, grad, row, column, lanes):
    if len(lanes) == 4:
        a, b, c, d = grad[row, column], grad[row, column + 1], grad[row, column + 2], grad[row, column + 3]
        for k in range(i, 8 * POINTS, POINTS):
            _give(into, offset + e[k], w[k], a, b, c, d)
        return
    if len(lanes) == 2:
        a, b = grad[row, column], grad[row, column + 1]
        for k in range(i, 8 * POINTS, POINTS):
            _give_two(into, offset + e[k], w[k], a, b)
        return
    for k in range(i, 8 * POINTS, POINTS):
        for f in range(len(lanes)):
            into[offset + e[k], f] += w[k] * grad[row, column + f]


@intrinsic
def _fetch(context: Any, address: Any) -> Any:
    """Prefetch the memory at an address."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place, word = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [place, word, word, word])
        prefetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(prefetch, [builder.inttoptr(arguments[0], place), word(0), word(3), word(1)])
        return context.get_dummy_value()

    return types.void(types.int64), code


@njit(fastmath=True)
@no_type_check
def _fetch_corners(first, size, e, i):
    for k in range(8):
        _fetch(first + size * np.int64(e[k * POINTS + i]))


@njit(fastmath=True)
@no_type_check
def _is_far(level, offsets, size):
    return size * (offsets[level + 1] - offsets[level]) > NEAR_BYTES


@njit(nogil=True, fastmath=True, cache=True)
@no_type_check
def encode(first, last, table, points, resolutions, offsets, hashed, mask, lanes, out):
    """Write the features of the points from first to last."""
    p, size = np.empty(3 * POINTS, np.float32), 4 * len(lanes)
    e, w = np.empty(8 * POINTS, np.int32), np.empty(8 * POINTS, np.float32)
    for start in range(first, last, POINTS):
        count = min(POINTS, last - start)
        _take_points(points, start, count, p)
        for level in range(resolutions.shape[0]):
            _find(p, resolutions[level], hashed[level], mask, e, w)
            entries, is_far = np.int64(table.ctypes.data) + size * offsets[level], _is_far(level, offsets, size)
            for i in range(AHEAD if is_far else 0):
                _fetch_corners(entries, size, e, i)
            for i in range(count):
                if is_far:
                    _fetch_corners(entries, size, e, min(i + AHEAD, POINTS - 1))
                _gather(table, offsets[level], e, w, i, out, start + i, level * len(lanes), lanes)


@njit(nogil=True, fastmath=True, cache=True)
@no_type_check
def _add_table_gradient(level, into, points, grad, resolutions, offsets, hashed, mask, lanes):
    p, size = np.empty(3 * POINTS, np.float32), 4 * len(lanes)
    e, w = np.empty(8 * POINTS, np.int32), np.empty(8 * POINTS, np.float32)
    entries, is_far = np.int64(into.ctypes.data) + size * offsets[level], _is_far(level, offsets, size)
    for start in range(0, points.shape[0], POINTS):
        count = min(POINTS, points.shape[0] - start)
        _take_points(points, start, count, p)
        _find(p, resolutions[level], hashed[level], mask, e, w)
        for i in range(AHEAD if is_far else 0):
            _fetch_corners(entries, size, e, i)
        for i in range(count):
            if is_far:
                _fetch_corners(entries, size, e, min(i + AHEAD, POINTS - 1))
            _scatter(into, offsets[level], e, w, i, grad, start + i, level * len(lanes), lanes)


@njit(nogil=True, fastmath=True, cache=True)
@no_type_check
def write_point_gradient(first, last, table, points, grad, resolutions, offsets, hashed, mask, lanes, out):
    """Write the gradients with respect to the points from first to last."""
    width = len(lanes)
    for i in range(first, last):
        gx = gy = gz = np.float32(0.0)
        for level in range(resolutions.shape[0]):
            resolution, column = resolutions[level], level * width
            x, fx = _cell(points[i, 0], resolution)
            y, fy = _cell(points[i, 1], resolution)
            z, fz = _cell(points[i, 2], resolution)
            e = _corners(x, y, z, resolution, offsets[level], hashed[level], mask)
            for k in range(8):
                value = np.float32(0.0)
                for f in range(width):
                    value += grad[i, column + f] * table[e[k], f]
                wx = fx if k & 1 else ONE - fx
                wy = fy if k & 2 else ONE - fy
                wz = fz if k & 4 else ONE - fz
                value *= np.float32(resolution)
                gx += (value if k & 1 else -value) * wy * wz
                gy += (value if k & 2 else -value) * wx * wz
                gz += (value if k & 4 else -value) * wx * wy
        # Outside the cube the features are constant.
        out[i, 0] = gx if 0.0 <= points[i, 0] <= 1.0 else np.float32(0.0)
        out[i, 1] = gy if 0.0 <= points[i, 1] <= 1.0 else np.float32(0.0)
        out[i, 2] = gz if 0.0 <= points[i, 2] <= 1.0 else np.float32(0.0)

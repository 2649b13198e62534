"""The hash grid for the CPU. The backward pass goes level by level, so two threads never write one entry.

`lanes` is a tuple of F zeros: its length is part of the compiled signature, so the loops over features become vectors.
"""

from typing import TYPE_CHECKING, Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor

from nerf_lightning.nerf.kernels.hash_grid.reference import PRIME_Y, PRIME_Z
from nerf_lightning.nerf.kernels.prefetch import prefetch
from nerf_lightning.nerf.kernels.threads import in_parallel, over_rows

COMPILED_WITH = "3ff815cc"
"""The state of the files from which something is compiled in: numba itself looks at this one alone."""

if TYPE_CHECKING:
    from nerf_lightning.nerf.kernels.hash_grid.layout import HashGridLayout

CHUNK = 1024
# A processor looks ahead two or three points by itself, and waits for memory most of the time; asked for so many points
# ahead, the entries of large levels come in time. Smaller levels than this stay in the cache.
AHEAD, LARGE_BYTES = 8, 1 << 18
SPREAD_Y, SPREAD_Z = np.uint32(PRIME_Y), np.uint32(PRIME_Z)
ONE = np.float32(1.0)


def forward(
    table: Float[Tensor, "entries features"], points: Float[Tensor, "points 3"], layout: "HashGridLayout"
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
    layout: "HashGridLayout",
) -> None:
    """Add the gradient with respect to the table to `into`."""
    given = (into.numpy(), points.numpy(), grad.numpy(), *level_arrays(layout), (0,) * into.shape[1])
    # Fine levels take longest: they come first.
    in_parallel(lambda level: _add_table_gradient(level, *given), range(len(layout.resolutions))[::-1])


def point_gradient(
    table: Float[Tensor, "entries features"],
    points: Float[Tensor, "points 3"],
    grad: Float[Tensor, "points out"],
    layout: "HashGridLayout",
) -> Float[Tensor, "points 3"]:
    """Return the gradient with respect to the points."""
    out = torch.empty_like(points)
    lanes = (0,) * table.shape[1]
    arrays = (table.numpy(), points.numpy(), grad.numpy(), *level_arrays(layout), lanes, out.numpy())
    over_rows(_point_gradient, points.shape[0], *arrays)
    return out


def trial() -> None:
    """Run every kernel once on next to nothing, for the widths that conf/model uses; it raises what compilers raise."""
    from nerf_lightning.nerf.kernels.hash_grid.layout import hash_grid_layout

    layout, points = hash_grid_layout(2, 6, 2, 8), torch.full((4, 3), 0.3)
    for features in (2, 4):
        table, grad = torch.zeros(layout.offsets[-1], features), torch.ones(4, 2 * features)
        forward(table, points, layout)
        add_table_gradient(table, points, grad, layout)
        point_gradient(table, points, grad, layout)


def level_arrays(layout: "HashGridLayout") -> tuple[Any, ...]:
    """Return what the kernels take of a layout."""
    resolutions = np.array(layout.resolutions, np.int32)
    hashed = np.array([layout.is_hashed(level) for level in range(len(resolutions))])
    return resolutions, np.array(layout.offsets, np.int64), hashed, np.uint32(layout.table_size - 1)


@njit(fastmath=True)
@no_type_check
def _cell(coordinate, resolution):
    scaled = min(max(coordinate, np.float32(0.0)), ONE) * np.float32(resolution)
    cell = min(np.int32(scaled), np.int32(resolution - 1))
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


# Four features are kept in registers as one vector: written one by one, the compiler must fear that what it stores is
# what it loads next, and takes a third longer.
@njit(fastmath=True)
@no_type_check
def _take(table, entry, weight, a, b, c, d):
    return (
        a + weight * table[entry, 0],
        b + weight * table[entry, 1],
        c + weight * table[entry, 2],
        d + weight * table[entry, 3],
    )


@njit(fastmath=True)
@no_type_check
def _give(into, entry, weight, a, b, c, d):
    p, q, r, s = into[entry, 0], into[entry, 1], into[entry, 2], into[entry, 3]
    into[entry, 0], into[entry, 1] = p + weight * a, q + weight * b
    into[entry, 2], into[entry, 3] = r + weight * c, s + weight * d


@njit(fastmath=True)
@no_type_check
def _gather(table, e, w, out, row, column, lanes):
    if len(lanes) == 4:
        a = b = c = d = np.float32(0.0)
        a, b, c, d = _take(table, e[0], w[0], a, b, c, d)
        a, b, c, d = _take(table, e[1], w[1], a, b, c, d)
        a, b, c, d = _take(table, e[2], w[2], a, b, c, d)
        a, b, c, d = _take(table, e[3], w[3], a, b, c, d)
        a, b, c, d = _take(table, e[4], w[4], a, b, c, d)
        a, b, c, d = _take(table, e[5], w[5], a, b, c, d)
        a, b, c, d = _take(table, e[6], w[6], a, b, c, d)
        a, b, c, d = _take(table, e[7], w[7], a, b, c, d)
        out[row, column], out[row, column + 1], out[row, column + 2], out[row, column + 3] = a, b, c, d
        return
    for f in range(len(lanes)):
        total = np.float32(0.0)
        for k in range(8):
            total += w[k] * table[e[k], f]
        out[row, column + f] = total


@njit(fastmath=True)
@no_type_check
def _scatter(into, e, w, grad, row, column, lanes):
    if len(lanes) == 4:
        a, b, c, d = grad[row, column], grad[row, column + 1], grad[row, column + 2], grad[row, column + 3]
        _give(into, e[0], w[0], a, b, c, d)
        _give(into, e[1], w[1], a, b, c, d)
        _give(into, e[2], w[2], a, b, c, d)
        _give(into, e[3], w[3], a, b, c, d)
        _give(into, e[4], w[4], a, b, c, d)
        _give(into, e[5], w[5], a, b, c, d)
        _give(into, e[6], w[6], a, b, c, d)
        _give(into, e[7], w[7], a, b, c, d)
        return
    for k in range(8):
        for f in range(len(lanes)):
            into[e[k], f] += w[k] * grad[row, column + f]


@njit(fastmath=True)
@no_type_check
def _ask_for(address, entry_bytes, e):
    # One by one: a loop over them would store them first.
    prefetch(address, e[0] * entry_bytes)
    prefetch(address, e[1] * entry_bytes)
    prefetch(address, e[2] * entry_bytes)
    prefetch(address, e[3] * entry_bytes)
    prefetch(address, e[4] * entry_bytes)
    prefetch(address, e[5] * entry_bytes)
    prefetch(address, e[6] * entry_bytes)
    prefetch(address, e[7] * entry_bytes)


# Each loop below finds a point's cell in the same four lines: a function that returned all of it took twice the time.
@njit(nogil=True, fastmath=True, cache=True)
@no_type_check
def encode(first, last, table, points, resolutions, offsets, hashed, mask, lanes, out):
    """Write the features of the points from first to last."""
    width = len(lanes)
    address, entry_bytes = np.int64(table.ctypes.data), np.int64(4 * width)
    for chunk in range(first, last, CHUNK):
        end = min(last, chunk + CHUNK)
        for level in range(resolutions.shape[0]):
            resolution, column = resolutions[level], level * width
            large = (offsets[level + 1] - offsets[level]) * entry_bytes > LARGE_BYTES
            for i in range(chunk, end):
                j = i + AHEAD
                if large and j < end:
                    x, fx = _cell(points[j, 0], resolution)
                    y, fy = _cell(points[j, 1], resolution)
                    z, fz = _cell(points[j, 2], resolution)
                    e = _corners(x, y, z, resolution, offsets[level], hashed[level], mask)
                    _ask_for(address, entry_bytes, e)
                x, fx = _cell(points[i, 0], resolution)
                y, fy = _cell(points[i, 1], resolution)
                z, fz = _cell(points[i, 2], resolution)
                e = _corners(x, y, z, resolution, offsets[level], hashed[level], mask)
                _gather(table, e, _weights(fx, fy, fz), out, i, column, lanes)


@njit(nogil=True, fastmath=True, cache=True)
@no_type_check
def _add_table_gradient(level, into, points, grad, resolutions, offsets, hashed, mask, lanes):
    resolution, column = resolutions[level], level * len(lanes)
    address, entry_bytes = np.int64(into.ctypes.data), np.int64(4 * len(lanes))
    large = (offsets[level + 1] - offsets[level]) * entry_bytes > LARGE_BYTES
    for i in range(points.shape[0]):
        j = i + AHEAD
        if large and j < points.shape[0]:
            x, fx = _cell(points[j, 0], resolution)
            y, fy = _cell(points[j, 1], resolution)
            z, fz = _cell(points[j, 2], resolution)
            e = _corners(x, y, z, resolution, offsets[level], hashed[level], mask)
            _ask_for(address, entry_bytes, e)
        x, fx = _cell(points[i, 0], resolution)
        y, fy = _cell(points[i, 1], resolution)
        z, fz = _cell(points[i, 2], resolution)
        e = _corners(x, y, z, resolution, offsets[level], hashed[level], mask)
        _scatter(into, e, _weights(fx, fy, fz), grad, i, column, lanes)


@njit(nogil=True, fastmath=True, cache=True)
@no_type_check
def _point_gradient(first, last, table, points, grad, resolutions, offsets, hashed, mask, lanes, out):
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
        # Outside of the cube the features do not change.
        out[i, 0] = gx if 0.0 <= points[i, 0] <= 1.0 else np.float32(0.0)
        out[i, 1] = gy if 0.0 <= points[i, 1] <= 1.0 else np.float32(0.0)
        out[i, 2] = gz if 0.0 <= points[i, 2] <= 1.0 else np.float32(0.0)

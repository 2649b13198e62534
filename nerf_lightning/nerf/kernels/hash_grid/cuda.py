"""The hash grid for CUDA: a program processes a block of points on one level; the backward pass adds atomically.

Everything is float32; features and their gradients may be bfloat16.
`TRITON_INTERPRET=1` runs the kernels without a GPU.
"""

import functools
from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.nerf.kernels.hash_grid.layout import PRIME_Y, PRIME_Z, HashGridLayout, hash_grid_layout
from nerf_lightning.nerf.kernels.hash_grid.reference import interpolate_torch
from nerf_lightning.nerf.kernels.padding import end_of_rows

BLOCK = 128
SPREAD_Y, SPREAD_Z = tl.constexpr(PRIME_Y), tl.constexpr(PRIME_Z)


def forward(
    table: Float[Tensor, "entries features"],
    points: Float[Tensor, "points 3"],
    layout: HashGridLayout,
    used: Int[Tensor, "1"] | None = None,
    dtype: torch.dtype = torch.float32,
) -> Float[Tensor, "points out"]:
    """Return the features; zeros from point `used` on, rounded up to a block."""
    levels, features = len(layout.resolutions), table.shape[1]
    out = torch.empty(points.shape[0], levels * features, dtype=dtype, device=points.device)
    if points.shape[0]:
        grid = (triton.cdiv(points.shape[0], BLOCK), levels)
        where = (
            *_levels(layout, points.device),
            out,
            used,
            points.shape[0],
            levels,
            features,
            triton.next_power_of_2(features),
            BLOCK,
        )
        _forward[grid](table, points, *where, enable_fp_fusion=True)
    return out


def add_table_gradient(
    into: Float[Tensor, "entries features"],
    points: Float[Tensor, "points 3"],
    grad: Float[Tensor, "points out"],
    layout: HashGridLayout,
    used: Int[Tensor, "1"] | None = None,
) -> None:
    """Add the gradient with respect to the table to `into`; points from `used` on have none."""
    levels, features = len(layout.resolutions), into.shape[1]
    if points.shape[0]:
        grid = (triton.cdiv(points.shape[0], BLOCK), levels)
        where = (
            *_levels(layout, points.device),
            grad,
            used,
            points.shape[0],
            levels,
            features,
            triton.next_power_of_2(features),
            BLOCK,
        )
        _backward[grid](into, points, *where, enable_fp_fusion=True)


def point_gradient(
    table: Float[Tensor, "entries features"],
    points: Float[Tensor, "points 3"],
    grad: Float[Tensor, "points out"],
    layout: HashGridLayout,
) -> Float[Tensor, "points 3"]:
    """Return the gradient with respect to the points, by the reference: it is rarely needed."""
    with torch.enable_grad():
        leaf = points.detach().requires_grad_()
        interpolate_torch(table.float(), leaf, layout).backward(grad.float())
    assert leaf.grad is not None
    return leaf.grad


def trial(device: str = "cuda") -> None:
    """Run every kernel once on tiny input; it raises whatever the compiler or driver raises."""
    layout, points = hash_grid_layout(2, 6, 2, 8), torch.full((4, 3), 0.3, device=device)
    table, grad = torch.zeros(layout.offsets[-1], 2, device=device), torch.ones(4, 4, device=device)
    used = torch.full((1,), 3, device=device)
    for count in (None, used):
        forward(table, points, layout, count)
        add_table_gradient(table, points, grad, layout, count)
    if not bool(table.isfinite().all()):  # read, so that a fault in the kernels appears here
        raise RuntimeError("a trial of its kernels gave numbers that are not finite")


# Cached: otherwise each call would copy these numbers to the device, and the host would wait for it.
@functools.cache
def _levels(layout: HashGridLayout, device: torch.device) -> tuple[Tensor, Tensor, Tensor, int]:
    hashed = [int(layout.is_hashed(level)) for level in range(len(layout.resolutions))]
    resolution, hashed_there = (
        torch.tensor(row, dtype=torch.int32, device=device) for row in (layout.resolutions, hashed)
    )
    # Entry indices times features may exceed 32 bits.
    offset = torch.tensor(layout.offsets[:-1], dtype=torch.int64, device=device)
    return resolution, offset, hashed_there, layout.table_size - 1


@triton.jit
@no_type_check
def _cell(points, row, axis, valid, resolution):
    coordinate = tl.load(points + row * 3 + axis, mask=valid, other=0.0)
    scaled = tl.minimum(tl.maximum(coordinate, 0.0), 1.0) * resolution.to(tl.float32)
    cell = tl.minimum(scaled.to(tl.int32), resolution - 1)
    return cell, scaled - cell.to(tl.float32)


@triton.jit
@no_type_check
def _entry(x, y, z, resolution, offset, hashed, mask):
    spread = x.to(tl.uint32) ^ (y.to(tl.uint32) * SPREAD_Y) ^ (z.to(tl.uint32) * SPREAD_Z)
    side = resolution + 1
    dense = x + side * (y + side * z)
    return offset + tl.where(hashed != 0, (spread & mask).to(tl.int32), dense)


@triton.jit
@no_type_check
def _locate(points, row, valid, resolution):
    x, fx = _cell(points, row, 0, valid, resolution)
    y, fy = _cell(points, row, 1, valid, resolution)
    z, fz = _cell(points, row, 2, valid, resolution)
    return x, y, z, fx, fy, fz


@triton.jit
@no_type_check
def _corner(corner: tl.constexpr, x, y, z, fx, fy, fz, resolution, offset, hashed, mask):
    a: tl.constexpr = corner & 1
    b: tl.constexpr = (corner >> 1) & 1
    c: tl.constexpr = corner >> 2
    weight = (fx if a else 1.0 - fx) * (fy if b else 1.0 - fy) * (fz if c else 1.0 - fz)
    return _entry(x + a, y + b, z + c, resolution, offset, hashed, mask), weight


@triton.jit
@no_type_check
def _level_of(resolutions, offsets, hashed_levels, count, width: tl.constexpr, block: tl.constexpr):
    """Return a program's points and features, and its level; a lane has all features of an entry."""
    row = (tl.program_id(0) * block + tl.arange(0, block)).to(tl.int64)[:, None]
    level = tl.program_id(1)
    resolution, offset = tl.load(resolutions + level), tl.load(offsets + level)
    hashed, feature = tl.load(hashed_levels + level), tl.arange(0, width)[None, :]
    return row, row < count, feature, level, resolution, offset, hashed


@triton.jit
@no_type_check
def _forward(
    table,
    points,
    resolutions,
    offsets,
    hashed_levels,
    mask,
    out,
    used,
    count,
    levels: tl.constexpr,
    features: tl.constexpr,
    width: tl.constexpr,
    block: tl.constexpr,
):
    row, valid, feature, level, resolution, offset, hashed = _level_of(
        resolutions, offsets, hashed_levels, count, width, block
    )
    there, at = valid & (feature < features), out + row * (levels * features) + level * features + feature
    if tl.program_id(0) * block >= end_of_rows(used, count):
        tl.store(at, tl.zeros([block, width], tl.float32), mask=there)
        return
    x, y, z, fx, fy, fz = _locate(points, row, valid, resolution)
    total = tl.zeros([block, width], tl.float32)
    for corner in tl.static_range(8):
        entry, weight = _corner(corner, x, y, z, fx, fy, fz, resolution, offset, hashed, mask)
        total += weight * tl.load(table + entry * features + feature, mask=there, other=0.0).to(tl.float32)
    tl.store(at, total, mask=there)


@triton.jit
@no_type_check
def _backward(
    into,
    points,
    resolutions,
    offsets,
    hashed_levels,
    mask,
    grad,
    used,
    count,
    levels: tl.constexpr,
    features: tl.constexpr,
    width: tl.constexpr,
    block: tl.constexpr,
):
    row, valid, feature, level, resolution, offset, hashed = _level_of(
        resolutions, offsets, hashed_levels, count, width, block
    )
    if tl.program_id(0) * block >= end_of_rows(used, count):
        return
    x, y, z, fx, fy, fz = _locate(points, row, valid, resolution)
    at = grad + row * (levels * features) + level * features + feature
    flowing = tl.load(at, mask=valid & (feature < features), other=0.0).to(tl.float32)
    # Most gradients are zero, from padding and from behind surfaces.
    flows = valid & (tl.max(tl.abs(flowing), axis=1, keep_dims=True) != 0.0) & (feature < features)
    for corner in tl.static_range(8):
        entry, weight = _corner(corner, x, y, z, fx, fy, fz, resolution, offset, hashed, mask)
        # Relaxed: nothing reads these before the kernel ends, and stricter semantics flush the cache.
        tl.atomic_add(into + entry * features + feature, weight * flowing, mask=flows, sem="relaxed")

"""The march for CUDA: a lane walks along a ray, and steps over cells and whole blocks that are empty.

It is done twice: to count a ray's intervals, and, once it is known where each ray's begin, to write them.
`TRITON_INTERPRET=1` runs the kernels without a GPU. The results are the same in each run.
"""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from nerf_lightning.nerf.geometry.boxes import center_and_half
from nerf_lightning.nerf.kernels.march.grid import BLOCK, MarchState, OccupancyCells, blocks_of, leaps_over
from nerf_lightning.nerf.types.rays import RaggedSamples, RayBundle

RAYS = 32
"""Of a program: a warp, whose lanes wait for each other."""


def march(
    rays: RayBundle,
    state: MarchState,
    lattice: Float[Tensor, "edges"],
    grid: OccupancyCells,
    limit: int | None,
    capacity: int | None,
) -> tuple[RaggedSamples, Int[Tensor, "rays"]]:
    """Return the occupied intervals and where each ray would go on; the arguments are those of `march.march`."""
    count, intervals, device = rays.near.shape[0], lattice.shape[0] - 2, lattice.device
    longest = intervals if limit is None else min(limit, intervals)
    counts = torch.empty(count, dtype=torch.int64, device=device)
    following = torch.empty_like(counts)
    center, half = center_and_half(grid.aabb)
    given = (rays.origins, rays.directions, state.enter, state.leave, state.jitter, state.next, lattice, center, half)
    arrays = *(each.contiguous() for each in given), grid.cells, grid.leaps
    sizes = count, intervals, grid.cells.shape[0], longest
    programs = (triton.cdiv(count, RAYS),)
    if count:
        _march[programs](*arrays, counts, following, counts, counts, counts, *sizes, 0, False, BLOCK, RAYS, num_warps=1)
    bounds = functional.pad(counts.cumsum(0), (1, 0))
    found = bounds[-1]
    if capacity is None:
        capacity = int(found)
    else:
        bounds = bounds.clamp(max=capacity)
    index = torch.empty(capacity, dtype=torch.int64, device=device)
    starts, ends = torch.empty(capacity, device=device), torch.empty(capacity, device=device)
    if count and capacity:
        out = bounds, index, index, starts, ends
        _march[programs](*arrays, *out, *sizes, capacity, True, BLOCK, RAYS, num_warps=1)
    return RaggedSamples(index, starts, ends, bounds, found, longest), following


def trial(device: str = "cuda") -> None:
    """Run every kernel once on next to nothing; it raises whatever its compiler or driver raises."""
    one, along = torch.ones(1, device=device), torch.tensor([[0.0, 0.0, 1.0]], device=device)
    rays = RayBundle(-2 * along, along, one, 3 * one, along)
    cells = torch.ones(4, 4, 4, dtype=torch.uint8, device=device)
    aabb = torch.tensor([[-1.0] * 3, [1.0] * 3], device=device)
    grid = OccupancyCells(aabb, cells, leaps_over(blocks_of(cells)))
    lattice = torch.linspace(1.0, 3.2, 12, device=device)
    samples, _ = march(rays, MarchState(one, 3 * one, 0 * one, 0 * one.long()), lattice, grid, None, None)
    if int(samples.found) != 10:
        raise RuntimeError("a trial of its kernels gave wrong numbers")


@triton.jit
@no_type_check
def _middle(lattice, jitter, k):
    a, b, c = tl.load(lattice + k), tl.load(lattice + k + 1), tl.load(lattice + k + 2)
    return 0.5 * (a + jitter * (b - a) + b + jitter * (c - b))


@triton.jit
@no_type_check
def _ahead(unit, speed, around):
    """Return the distance to the end of the cell, of side 1, that `unit` lies in and of `around` more, on one axis."""
    still = speed == 0.0
    edge = tl.where(speed > 0.0, tl.floor(unit) + 1.0 + around, tl.floor(unit) - around)
    return tl.where(still, 1e30, (edge - unit) / tl.where(still, 1.0, speed))


@triton.jit
@no_type_check
def _march(
    origins, directions, enter, leave, jitters, first, lattice, center, half, cells, leaps,
    bounds, following, index, starts, ends, count, intervals, resolution, most, capacity,
    write: tl.constexpr, side: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    lane = tl.arange(0, block)
    ray = tl.program_id(0) * block + lane
    valid = ray < count
    # In coordinates of the box, which is the cube from -1 to 1.
    hx, hy, hz = tl.load(half), tl.load(half + 1), tl.load(half + 2)
    ox = (tl.load(origins + 3 * ray, mask=valid, other=0.0) - tl.load(center)) / hx
    oy = (tl.load(origins + 3 * ray + 1, mask=valid, other=0.0) - tl.load(center + 1)) / hy
    oz = (tl.load(origins + 3 * ray + 2, mask=valid, other=0.0) - tl.load(center + 2)) / hz
    dx = tl.load(directions + 3 * ray, mask=valid, other=0.0) / hx
    dy = tl.load(directions + 3 * ray + 1, mask=valid, other=0.0) / hy
    dz = tl.load(directions + 3 * ray + 2, mask=valid, other=0.0) / hz
    near, far = tl.load(enter + ray, mask=valid, other=1.0), tl.load(leave + ray, mask=valid, other=0.0)
    jitter = tl.load(jitters + ray, mask=valid, other=0.0)
    k = tl.load(first + ray, mask=valid, other=0).to(tl.int32)
    longest = tl.load(lattice + intervals + 1) - tl.load(lattice + intervals)
    scale, blocks = 0.5 * resolution, resolution // side
    found = tl.zeros([block], tl.int32)
    begin, room = tl.zeros([block], tl.int64), tl.full([block], most, tl.int32)
    if write:
        begin = tl.load(bounds + ray, mask=valid, other=0)
        room = (tl.load(bounds + ray + 1, mask=valid, other=0) - begin).to(tl.int32)
    alive = valid & (near < far) & (k < intervals) & (room > 0)
    # Rays outside of the box pass to the lattice's end at once.
    k = tl.where(valid & ~(near < far), intervals, k)
    while tl.max(alive.to(tl.int32), axis=0) > 0:
        at = tl.where(alive, k, 0)
        t = _middle(lattice, jitter, at)
        ended = alive & (t > far)
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        inside = tl.maximum(tl.maximum(tl.abs(x), tl.abs(y)), tl.abs(z)) <= 1.0
        asks = alive & ~ended & inside & (t >= near)
        x, y, z = (x + 1.0) * scale, (y + 1.0) * scale, (z + 1.0) * scale
        a = tl.minimum(tl.maximum(x.to(tl.int32), 0), resolution - 1)
        b = tl.minimum(tl.maximum(y.to(tl.int32), 0), resolution - 1)
        c = tl.minimum(tl.maximum(z.to(tl.int32), 0), resolution - 1)
        occupied = asks & (tl.load(cells + (a * resolution + b) * resolution + c, mask=asks, other=0) != 0)
        if write:
            low, high = tl.load(lattice + at), tl.load(lattice + at + 1)
            into = begin + found
            tl.store(index + into, ray.to(tl.int64), mask=occupied)
            tl.store(starts + into, low + jitter * (high - low), mask=occupied)
            tl.store(ends + into, high + jitter * (tl.load(lattice + at + 2) - high), mask=occupied)
        found += occupied.to(tl.int32)
        # To the end of what is empty around, a hair short: no interval too far.
        leap = tl.load(leaps + ((a // side) * blocks + b // side) * blocks + c // side, mask=asks, other=0)
        wide = leap > 0
        shrink, around = tl.where(wide, 1.0 / side, 1.0), tl.where(wide, leap.to(tl.float32) - 1.0, 0.0)
        speed = scale * shrink
        ahead = tl.minimum(
            tl.minimum(_ahead(x * shrink, dx * speed, around), _ahead(y * shrink, dy * speed, around)),
            _ahead(z * shrink, dz * speed, around),
        )
        # Before the box: one step less than leads to where the ray enters.
        ahead = tl.where(asks, ahead * 0.9999, tl.maximum(near - t, 0.0) - longest)
        skipped = tl.maximum(tl.minimum(ahead / longest, 1048576.0).to(tl.int32), 1)
        k = tl.where(alive & ~ended, k + tl.where(occupied, 1, skipped), k)
        k = tl.where(ended, intervals, tl.minimum(k, intervals))
        alive = alive & ~ended & (k < intervals) & (found < room)
    if write:
        # Padding of no length, spread over the rays.
        used = tl.load(bounds + count)
        for start in range(used + tl.program_id(0) * block, capacity, tl.num_programs(0) * block):
            slot = start + lane
            rest = slot < capacity
            tl.store(index + slot, (slot % count).to(tl.int64), mask=rest)
            tl.store(starts + slot, tl.zeros([block], tl.float32), mask=rest)
            tl.store(ends + slot, tl.zeros([block], tl.float32), mask=rest)
    else:
        tl.store(bounds + ray, found.to(tl.int64), mask=valid)
        tl.store(following + ray, k.to(tl.int64), mask=valid)

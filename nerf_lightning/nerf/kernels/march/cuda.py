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

from nerf_lightning.nerf.kernels.march.grid import BLOCK, MarchState, OccupancyCells, blocks_of, leaps_over
from nerf_lightning.nerf.types.rays import RaggedSamples, RayBundle

LANES = 256
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
    bounds = torch.empty(count + 1, dtype=torch.int64, device=device)
    following = torch.empty_like(bounds[1:])
    given = (rays.origins, rays.directions, state.enter, state.leave, state.jitter, state.next, lattice, grid.aabb)
    arrays = *(each.contiguous() for each in given), grid.cells, grid.leaps
    sizes = count, intervals, grid.cells.shape[0], longest
    programs = (max(1, triton.cdiv(count, RAYS)),)
    _march[programs](*arrays, bounds, following, bounds, bounds, bounds, *sizes, 0, False, BLOCK, RAYS, num_warps=1)
    bounds = bounds.cumsum(0)
    found = bounds[-1]
    if capacity is None:
        capacity = int(found)
    else:
        bounds = bounds.clamp(max=capacity)  # the last rays lose what does not fit
    index = torch.empty(capacity, dtype=torch.int64, device=device)
    starts, ends = torch.empty(capacity, device=device), torch.empty(capacity, device=device)
    if count:
        out = bounds, index, index, starts, ends
        _march[programs](*arrays, *out, *sizes, capacity, True, BLOCK, RAYS, num_warps=1)
    return RaggedSamples(index, starts, ends, bounds, found, longest), following


def distances_in_box(
    rays: RayBundle, aabb: Float[Tensor, "2 3"]
) -> tuple[Float[Tensor, "rays"], Float[Tensor, "rays"]]:
    """Return where each ray enters and leaves a box (`geometry.boxes.distances_in_box`)."""
    enter, leave = torch.empty_like(rays.near), torch.empty_like(rays.near)
    if count := rays.near.shape[0]:
        given = rays.origins, rays.directions, rays.near, rays.far, aabb
        arrays = *(each.contiguous() for each in given), enter, leave
        _enter[(triton.cdiv(count, LANES),)](*arrays, count, LANES)
    return enter, leave


def trial(device: str = "cuda") -> None:
    """Run every kernel once on next to nothing; it raises whatever its compiler or driver raises."""
    one, along = torch.ones(1, device=device), torch.tensor([[0.0, 0.0, 1.0]], device=device)
    rays = RayBundle(-2 * along, along, one, 3 * one, along)
    cells = torch.ones(4, 4, 4, dtype=torch.uint8, device=device)
    aabb = torch.tensor([[-1.0] * 3, [1.0] * 3], device=device)
    grid = OccupancyCells(aabb, cells, leaps_over(blocks_of(cells)))
    lattice = torch.linspace(1.0, 3.2, 12, device=device)
    enter, leave = distances_in_box(rays, aabb)
    samples, _ = march(rays, MarchState(enter, leave, 0 * one, 0 * one.long()), lattice, grid, None, None)
    if int(samples.found) != 10:
        raise RuntimeError("a trial of its kernels gave wrong numbers")


@triton.jit
@no_type_check
def _in_box(origins, directions, aabb, ray, valid, axis: tl.constexpr):
    """Return one coordinate of origins and directions where the box is the cube from -1 to 1."""
    low, high = tl.load(aabb + axis), tl.load(aabb + 3 + axis)
    half = 0.5 * (high - low)
    origin = tl.load(origins + 3 * ray + axis, mask=valid, other=0.0) - 0.5 * (low + high)
    return origin / half, tl.load(directions + 3 * ray + axis, mask=valid, other=0.0) / half


@triton.jit
@no_type_check
def _between_faces(origins, directions, aabb, ray, valid, axis: tl.constexpr):
    """Return where rays pass the two faces of the box on an axis, the nearer first."""
    direction = tl.load(directions + 3 * ray + axis, mask=valid, other=1.0)
    inverse = 1.0 / tl.where(direction == 0.0, 1e-20, direction)
    origin = tl.load(origins + 3 * ray + axis, mask=valid, other=0.0)
    a, b = (tl.load(aabb + axis) - origin) * inverse, (tl.load(aabb + 3 + axis) - origin) * inverse
    return tl.minimum(a, b), tl.maximum(a, b)


@triton.jit
@no_type_check
def _enter(origins, directions, near, far, aabb, enter, leave, count, block: tl.constexpr):
    ray = tl.program_id(0) * block + tl.arange(0, block)
    valid = ray < count
    x0, x1 = _between_faces(origins, directions, aabb, ray, valid, 0)
    y0, y1 = _between_faces(origins, directions, aabb, ray, valid, 1)
    z0, z1 = _between_faces(origins, directions, aabb, ray, valid, 2)
    first = tl.maximum(tl.maximum(x0, y0), tl.maximum(z0, tl.load(near + ray, mask=valid, other=0.0)))
    last = tl.minimum(tl.minimum(x1, y1), tl.minimum(z1, tl.load(far + ray, mask=valid, other=0.0)))
    tl.store(enter + ray, first, mask=valid)
    tl.store(leave + ray, last, mask=valid)


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
    origins, directions, enter, leave, jitters, first, lattice, aabb, cells, leaps,
    bounds, following, index, starts, ends, count, intervals, resolution, most, capacity,
    write: tl.constexpr, side: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    lane = tl.arange(0, block)
    ray = tl.program_id(0) * block + lane
    valid = ray < count
    ox, dx = _in_box(origins, directions, aabb, ray, valid, 0)
    oy, dy = _in_box(origins, directions, aabb, ray, valid, 1)
    oz, dz = _in_box(origins, directions, aabb, ray, valid, 2)
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
        tl.store(bounds + 1 + ray, found.to(tl.int64), mask=valid)
        if tl.program_id(0) == 0:
            tl.store(bounds, 0)
        tl.store(following + ray, k.to(tl.int64), mask=valid)

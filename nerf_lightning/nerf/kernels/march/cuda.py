"""The march for CUDA: a lane walks along a part of a ray, and skips empty cells and whole empty blocks.

It notes which intervals are occupied; once the number before each part is known, they are written contiguously.
`TRITON_INTERPRET=1` runs the kernels without a GPU. Results are deterministic.
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
WALKS = 32
"""Walks per program: a warp, whose lanes wait for each other."""
PARTS = 8
"""Parts of a ray that are walked at once: steps wait for memory, and a batch's rays alone do not fill a GPU."""


def march(
    rays: RayBundle,
    state: MarchState,
    lattice: Float[Tensor, "edges"],
    grid: OccupancyCells,
    limit: int | None,
    capacity: int | None,
) -> tuple[RaggedSamples, Int[Tensor, "rays"]]:
    """Return the occupied intervals and where each ray would continue; the arguments are those of `march.march`."""
    count, intervals, device = rays.near.shape[0], lattice.shape[0] - 2, lattice.device
    # How far a ray with limited samples goes is known only at its end.
    parts, longest = (PARTS, intervals) if limit is None else (1, min(limit, intervals))
    room = triton.cdiv(longest, parts)
    walks = count * parts
    ends_of_walks = torch.empty(walks + 1, dtype=torch.int64, device=device)
    bounds = torch.empty(count + 1, dtype=torch.int64, device=device)
    following, noted = torch.empty_like(bounds[1:]), torch.empty(walks, room, dtype=torch.int32, device=device)
    given = (rays.origins, rays.directions, state.enter, state.leave, state.jitter, state.next, lattice, grid.aabb)
    arrays = *(each.contiguous() for each in given), grid.cells, grid.leaps
    sizes = walks, intervals, grid.cells.shape[0], room, parts
    programs = (max(1, triton.cdiv(walks, WALKS)),)
    _march[programs](*arrays, ends_of_walks, following, noted, *sizes, BLOCK, WALKS, num_warps=1)
    ends_of_walks = ends_of_walks.cumsum(0)
    found = ends_of_walks[-1]
    if capacity is None:
        capacity = int(found)
    else:
        ends_of_walks = ends_of_walks.clamp(max=capacity)  # what does not fit is dropped from the last rays
    index = torch.empty(capacity, dtype=torch.int64, device=device)
    starts, ends = torch.empty(capacity, device=device), torch.empty(capacity, device=device)
    out = bounds, index, starts, ends
    arrays = lattice.contiguous(), state.jitter.contiguous(), ends_of_walks, noted
    _write[(max(1, count),)](*arrays, *out, count, room, capacity, parts, WALKS, num_warps=1)
    return RaggedSamples(index, starts, ends, bounds, found, longest), following


def distances_in_box(
    rays: RayBundle, aabb: Float[Tensor, "2 3"]
) -> tuple[Float[Tensor, "*rays"], Float[Tensor, "*rays"]] | None:
    """Return where each ray enters and leaves a box; None if rays are not contiguous, or gradients are needed."""
    if rays.near.dim() != 1 or rays.origins.requires_grad or rays.directions.requires_grad:
        return None
    enter, leave = torch.empty_like(rays.near), torch.empty_like(rays.near)
    if count := rays.near.shape[0]:
        given = rays.origins, rays.directions, rays.near, rays.far, aabb
        arrays = *(each.contiguous() for each in given), enter, leave
        _enter[(triton.cdiv(count, LANES),)](*arrays, count, LANES)
    return enter, leave


def trial(device: str = "cuda") -> None:
    """Run every kernel once on tiny input; it raises whatever the compiler or driver raises."""
    one, along = torch.ones(1, device=device), torch.tensor([[0.0, 0.0, 1.0]], device=device)
    rays = RayBundle(-2 * along, along, one, 3 * one, along)
    cells = torch.ones(4, 4, 4, dtype=torch.uint8, device=device)
    aabb = torch.tensor([[-1.0] * 3, [1.0] * 3], device=device)
    grid = OccupancyCells(aabb, cells, leaps_over(blocks_of(cells)))
    lattice = torch.linspace(1.0, 3.2, 12, device=device)
    enter, leave = distances_in_box(rays, aabb) or (one, one)
    samples, _ = march(rays, MarchState(enter, leave, 0 * one, 0 * one.long()), lattice, grid, None, None)
    if int(samples.found) != 10:
        raise RuntimeError("a trial of its kernels gave wrong numbers")


@triton.jit
@no_type_check
def _in_box(origins, directions, aabb, ray, valid, axis: tl.constexpr):
    """Return one coordinate of origins and directions, in coordinates where the box is the cube from -1 to 1."""
    low, high = tl.load(aabb + axis), tl.load(aabb + 3 + axis)
    half = 0.5 * (high - low)
    origin = tl.load(origins + 3 * ray + axis, mask=valid, other=0.0) - 0.5 * (low + high)
    return origin / half, tl.load(directions + 3 * ray + axis, mask=valid, other=0.0) / half


@triton.jit
@no_type_check
def _between_faces(origins, directions, aabb, ray, valid, axis: tl.constexpr):
    """Return where rays cross the two faces of the box on an axis, the nearer first."""
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
    """Return the distance along one axis to the end of the cell (side 1) that contains `unit`, and of `around` more."""
    still = speed == 0.0
    edge = tl.where(speed > 0.0, tl.floor(unit) + 1.0 + around, tl.floor(unit) - around)
    return tl.where(still, 1e30, (edge - unit) / tl.where(still, 1.0, speed))


@triton.jit
@no_type_check
def _march(
    origins, directions, enter, leave, jitters, first, lattice, aabb, cells, leaps,
    ends_of_walks, following, noted, walks, intervals, resolution, room, parts: tl.constexpr,
    side: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    walk = tl.program_id(0) * block + tl.arange(0, block)
    valid, ray = walk < walks, walk // parts
    ox, dx = _in_box(origins, directions, aabb, ray, valid, 0)
    oy, dy = _in_box(origins, directions, aabb, ray, valid, 1)
    oz, dz = _in_box(origins, directions, aabb, ray, valid, 2)
    near, far = tl.load(enter + ray, mask=valid, other=1.0), tl.load(leave + ray, mask=valid, other=0.0)
    jitter = tl.load(jitters + ray, mask=valid, other=0.0)
    k = tl.load(first + ray, mask=valid, other=0).to(tl.int32)
    last = tl.full([block], intervals, tl.int32)
    if parts > 1:
        begin = walk % parts * room
        k, last = tl.maximum(k, begin), tl.minimum(last, begin + room)
    longest = tl.load(lattice + intervals + 1) - tl.load(lattice + intervals)
    scale, blocks = 0.5 * resolution, resolution // side
    found, into = tl.zeros([block], tl.int32), noted + walk.to(tl.int64) * room
    alive = valid & (near < far) & (k < last)
    # Rays that miss the box go to the lattice's end at once.
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
        tl.store(into + found, at, mask=occupied)
        found += occupied.to(tl.int32)
        # To the end of the empty space around, slightly short: never an interval too far.
        leap = tl.load(leaps + ((a // side) * blocks + b // side) * blocks + c // side, mask=asks, other=0)
        wide = leap > 0
        shrink, around = tl.where(wide, 1.0 / side, 1.0), tl.where(wide, leap.to(tl.float32) - 1.0, 0.0)
        speed = scale * shrink
        ahead = tl.minimum(
            tl.minimum(_ahead(x * shrink, dx * speed, around), _ahead(y * shrink, dy * speed, around)),
            _ahead(z * shrink, dz * speed, around),
        )
        # Before the box: one step less than to where the ray enters.
        ahead = tl.where(asks, ahead * 0.9999, tl.maximum(near - t, 0.0) - longest)
        skipped = tl.maximum(tl.minimum(ahead / longest, 1048576.0).to(tl.int32), 1)
        k = tl.where(alive & ~ended, k + tl.where(occupied, 1, skipped), k)
        k = tl.where(ended, intervals, tl.minimum(k, intervals))
        alive = alive & ~ended & (k < last) & (found < room)
    tl.store(ends_of_walks + 1 + walk, found.to(tl.int64), mask=valid)
    if tl.program_id(0) == 0:
        tl.store(ends_of_walks, 0)
    # The last of a ray's walks says where it would continue; after several walks nothing is left.
    tl.store(following + ray, tl.minimum(k, intervals).to(tl.int64), mask=valid & (walk % parts == parts - 1))


@triton.jit
@no_type_check
def _write(
    lattice, jitters, ends_of_walks, noted, bounds, index, starts, ends, count, room, capacity,
    parts: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    ray, lane, part = tl.program_id(0).to(tl.int64), tl.arange(0, block), tl.arange(0, parts)
    used = tl.load(ends_of_walks + count * parts)
    tl.store(bounds + count, used, mask=ray == 0)
    if ray < count:
        jitter, walk = tl.load(jitters + ray), ray * parts
        first, last = tl.load(ends_of_walks + walk), tl.load(ends_of_walks + walk + parts)
        tl.store(bounds + ray, first)
        begins, stops = tl.load(ends_of_walks + walk + part), tl.load(ends_of_walks + walk + part + 1)
        for start in range(first, last, block):
            slot = start + lane
            inside = slot < last
            own = (slot[:, None] >= begins[None, :]) & (slot[:, None] < stops[None, :])
            # Where the interval's number is stored: in the row of its walk.
            at = tl.sum(tl.where(own, (walk + part[None, :]) * room + slot[:, None] - begins[None, :], 0), axis=1)
            k = tl.load(noted + at, mask=inside, other=0)
            low, middle, high = tl.load(lattice + k), tl.load(lattice + k + 1), tl.load(lattice + k + 2)
            tl.store(index + slot, ray + 0 * slot, mask=inside)
            tl.store(starts + slot, low + jitter * (middle - low), mask=inside)
            tl.store(ends + slot, middle + jitter * (high - middle), mask=inside)
        # Padding of no length, spread over the rays.
        for start in range(used + ray * block, capacity, count * block):
            slot = start + lane
            tl.store(index + slot, slot % count, mask=slot < capacity)
            tl.store(starts + slot, tl.zeros([block], tl.float32), mask=slot < capacity)
            tl.store(ends + slot, tl.zeros([block], tl.float32), mask=slot < capacity)

"""The march for the CPU: it skips empty cells, and whole empty blocks with the empty blocks around them."""

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import njit
from torch import Tensor

from nerf_lightning.nerf.kernels.march.grid import BLOCK, MarchState, OccupancyCells, blocks_of, leaps_over
from nerf_lightning.nerf.kernels.threads import over_rows
from nerf_lightning.nerf.types.rays import RaggedSamples, RayBundle

HALF, ONE = np.float32(0.5), np.float32(1.0)
FAR_AWAY = np.float32(1e30)


def march(
    rays: RayBundle, state: MarchState, lattice: Float[Tensor, "edges"], grid: OccupancyCells, limit: int | None
) -> tuple[RaggedSamples, Int[Tensor, "rays"]]:
    """Return the occupied intervals and where each ray would continue."""
    count, edges = rays.near.shape[0], lattice.shape[0]
    most = min(edges, limit if limit is not None else edges)
    ray = (*grid.in_box(rays), state.enter, state.leave, state.jitter)
    numbers = torch.empty(count, most, dtype=torch.int16)
    bounds, following = torch.zeros(count + 1, dtype=torch.int64), torch.empty(count, dtype=torch.int64)
    arrays = (*ray, lattice, grid.cells, grid.leaps, state.next, numbers, bounds, following)
    over_rows(_find, count, *(x.contiguous().numpy() for x in arrays))
    torch.cumsum(bounds, 0, out=bounds)
    total = int(bounds[-1])
    out = torch.empty(total, dtype=torch.int64), torch.empty(total), torch.empty(total)
    over_rows(_pack, count, *(x.numpy() for x in (state.jitter.contiguous(), lattice, numbers, bounds, *out)))
    return RaggedSamples(*out, bounds, bounds[-1], most), following


def trial() -> None:
    """Run every kernel once on tiny input; it raises whatever the compiler raises."""
    one, along = torch.ones(1), torch.tensor([[0.0, 0.0, 1.0]])
    rays = RayBundle(torch.tensor([[0.0, 0.0, -2.0]]), along, one, 3 * one, along)
    cells, aabb = torch.ones(4, 4, 4, dtype=torch.uint8), torch.tensor([[-1.0] * 3, [1.0] * 3])
    grid = OccupancyCells(aabb, cells, leaps_over(blocks_of(cells)))
    march(rays, MarchState(one, 3 * one, 0 * one, 0 * one.long()), torch.linspace(1.0, 3.2, 12), grid, None)


@njit(fastmath=True)
@no_type_check
def edge(lattice, jitter, k):
    """Return where interval k of a ray begins."""
    return lattice[k] + jitter * (lattice[k + 1] - lattice[k])


@njit(fastmath=True)
@no_type_check
def middle(lattice, jitter, k):
    """Return the middle of interval k of a ray."""
    return HALF * (edge(lattice, jitter, k) + edge(lattice, jitter, k + 1))


@njit(fastmath=True)
@no_type_check
def first_from(lattice, jitter, k, t):
    """Return the first interval, not before k, whose middle is not before t."""
    low, high = k, lattice.shape[0] - 2
    while low < high:
        between = (low + high) // 2
        if middle(lattice, jitter, between) < t:
            low = between + 1
        else:
            high = between
    return low


@njit(fastmath=True)
@no_type_check
def _ahead(unit, speed, around):
    # Distance along one axis to the end of the cell (side 1) that contains `unit`, and of `around` cells beyond it.
    if speed > 0:
        return (np.floor(unit) + ONE + around - unit) / speed
    if speed < 0:
        return (np.floor(unit) - around - unit) / speed
    return FAR_AWAY


@njit(fastmath=True)
@no_type_check
def _end_of_empty(x, y, z, dx, dy, dz, leap, scale):
    # Distance to the end of the empty space (a cell, or blocks) around a point given in cells; slightly short.
    around = np.float32(0.0)
    if leap > 0:
        shrink, around = ONE / np.float32(BLOCK), np.float32(leap) - ONE
        x, y, z, scale = x * shrink, y * shrink, z * shrink, scale * shrink
    ahead = min(_ahead(x, dx * scale, around), _ahead(y, dy * scale, around), _ahead(z, dz * scale, around))
    return ahead * np.float32(0.9999)


@njit(fastmath=True)
@no_type_check
def _skip(lattice, jitter, k, t, ahead):
    # The first interval after k (whose middle is at t) that is so far ahead; never one too far.
    end = lattice.shape[0] - 2
    longest = lattice[end + 1] - lattice[end]
    k += max(1, int(ahead / longest))
    while k < end and middle(lattice, jitter, k) < t + ahead:
        k += 1
    return k


@njit(fastmath=True)
@no_type_check
def next_occupied(ox, oy, oz, dx, dy, dz, leave, lattice, jitter, cells, leaps, k):
    """Return the first occupied interval from k on; the lattice's end if there is none."""
    end, resolution = lattice.shape[0] - 2, np.int32(cells.shape[0])
    last, scale = resolution - np.int32(1), HALF * np.float32(resolution)
    while k < end:
        t = middle(lattice, jitter, k)
        if t > leave:
            break
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        if max(abs(x), abs(y), abs(z)) > ONE:
            k += 1
            continue
        x, y, z = (x + ONE) * scale, (y + ONE) * scale, (z + ONE) * scale
        a, b, c = min(np.int32(x), last), min(np.int32(y), last), min(np.int32(z), last)
        if cells[a, b, c]:
            return k
        leap = leaps[a // BLOCK, b // BLOCK, c // BLOCK]
        k = _skip(lattice, jitter, k, t, _end_of_empty(x, y, z, dx, dy, dz, leap, scale))
    return end


@njit(fastmath=True)
@no_type_check
def _walk(ox, oy, oz, dx, dy, dz, leave, lattice, jitter, cells, leaps, k, numbers):
    # Write the numbers of the occupied intervals from k on; return how many, and where to continue.
    end, found = lattice.shape[0] - 2, 0
    while found < numbers.shape[0]:
        k = next_occupied(ox, oy, oz, dx, dy, dz, leave, lattice, jitter, cells, leaps, k)
        if k >= end:
            return found, end
        numbers[found] = k
        found += 1
        k += 1
    return found, min(k, end)


@njit(nogil=True, fastmath=True, cache=True)
@no_type_check
def _find(first_ray, last_ray, o, d, enter, leave, jitters, lattice, cells, leaps, first, numbers, bounds, following):
    for r in range(first_ray, last_ray):
        found, k = 0, lattice.shape[0] - 2
        if enter[r] < leave[r]:
            k = first_from(lattice, jitters[r], first[r], enter[r])
            found, k = _walk(
                *(o[r, 0], o[r, 1], o[r, 2], d[r, 0], d[r, 1], d[r, 2]),
                *(leave[r], lattice, jitters[r], cells, leaps, k, numbers[r]),
            )
        bounds[r + 1] = found
        following[r] = k


@njit(nogil=True, fastmath=True, cache=True)
@no_type_check
def _pack(first_ray, last_ray, jitters, lattice, numbers, bounds, index, starts, ends):
    for r in range(first_ray, last_ray):
        for sample in range(bounds[r], bounds[r + 1]):
            k = numbers[r, sample - bounds[r]]
            index[sample] = r
            starts[sample] = edge(lattice, jitters[r], k)
            ends[sample] = edge(lattice, jitters[r], k + 1)

"""The march for the CPU: whole blocks and cells that are empty are stepped over."""

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import njit, prange
from torch import Tensor

from nerf_lightning.kernels.march import BLOCK, OPAQUE, March, OccupancyCells
from nerf_lightning.types import PackedSamples, RayBundle

HALF, ONE, TWO = np.float32(0.5), np.float32(1.0), np.float32(2.0)
FAR_AWAY = np.float32(1e30)


def march(
    rays: RayBundle, state: March, lattice: Float[Tensor, "edges"], grid: OccupancyCells, limit: int | None
) -> tuple[PackedSamples, Int[Tensor, "rays"]]:
    """Return the occupied intervals and where each ray would go on."""
    count, edges = rays.near.shape[0], lattice.shape[0]
    most = min(edges, limit if limit is not None else edges)
    # In coordinates of the box, which is the cube from -1 to 1.
    half = 0.5 * (grid.aabb[1] - grid.aabb[0])
    origins = (rays.origins - grid.aabb.mean(dim=0)) / half
    path = (origins, rays.directions / half, state.enter, state.leave, state.jitter, lattice)
    path = (*path, grid.cells, grid.blocks, grid.floor)
    numbers = torch.empty(count, most, dtype=torch.int16)
    bounds, following = torch.zeros(count + 1, dtype=torch.int64), torch.empty(count, dtype=torch.int64)
    _find(*(x.contiguous().numpy() for x in (*path, state.next, numbers, bounds, following)))
    torch.cumsum(bounds, 0, out=bounds)
    total = int(bounds[-1])
    out = torch.empty(total, dtype=torch.int64), torch.empty(total), torch.empty(total)
    _pack(*(x.numpy() for x in (state.jitter.contiguous(), lattice, numbers, bounds, *out)))
    return PackedSamples(*out, bounds, bounds[-1]), following


@njit(fastmath=True)
@no_type_check
def _edge(lattice, jitter, k):
    return lattice[k] + jitter * (lattice[k + 1] - lattice[k])


@njit(fastmath=True)
@no_type_check
def _middle(lattice, jitter, k):
    return HALF * (_edge(lattice, jitter, k) + _edge(lattice, jitter, k + 1))


@njit(fastmath=True)
@no_type_check
def _first_from(lattice, jitter, k, t):
    # The first interval, not before k, whose middle is not before t.
    low, high = k, lattice.shape[0] - 2
    while low < high:
        between = (low + high) // 2
        if _middle(lattice, jitter, between) < t:
            low = between + 1
        else:
            high = between
    return low


@njit(fastmath=True)
@no_type_check
def _ahead(unit, speed, inverse):
    # Distance to the end of the cell, of side 1, that `unit` lies in, along one axis.
    if speed > 0:
        return (np.floor(unit) + ONE - unit) * inverse
    if speed < 0:
        return (np.floor(unit) - unit) * inverse
    return FAR_AWAY


@njit(parallel=True, fastmath=True, cache=True)
@no_type_check
def _find(o, d, enter, leave, jitters, lattice, cells, blocks, floor, first, numbers, bounds, following):
    end, limit = lattice.shape[0] - 2, numbers.shape[1]
    longest = lattice[end + 1] - lattice[end]
    cascades, resolution = cells.shape[0], np.int32(cells.shape[1])
    for r in prange(o.shape[0]):
        jitter, ox, oy, oz, dx, dy, dz = jitters[r], o[r, 0], o[r, 1], o[r, 2], d[r, 0], d[r, 1], d[r, 2]
        ix, iy, iz = ONE / (dx if dx != 0 else ONE), ONE / (dy if dy != 0 else ONE), ONE / (dz if dz != 0 else ONE)
        found, k, optical = 0, end, np.float32(0.0)
        if enter[r] < leave[r]:
            k = _first_from(lattice, jitter, first[r], enter[r])
        while k < end and found < limit:
            t = _middle(lattice, jitter, k)
            if t > leave[r]:
                k = end
                break
            x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
            reach = max(abs(x), abs(y), abs(z))
            cascade, size = 0, ONE
            while reach > size and cascade < cascades - 1:
                cascade += 1
                size *= TWO
            if reach > size:
                k += 1
                continue
            scale = HALF * np.float32(resolution) / size
            ux, uy, uz = (x + size) * scale, (y + size) * scale, (z + size) * scale
            i = min(np.int32(ux), resolution - np.int32(1))
            j = min(np.int32(uy), resolution - np.int32(1))
            m = min(np.int32(uz), resolution - np.int32(1))
            if cells[cascade, i, j, m]:
                if optical > OPAQUE:
                    k = end
                    break
                optical += floor[cascade, i, j, m] * (_edge(lattice, jitter, k + 1) - _edge(lattice, jitter, k))
                numbers[r, found] = k
                found += 1
                k += 1
                continue
            if not blocks[cascade, i // BLOCK, j // BLOCK, m // BLOCK]:
                scale /= np.float32(BLOCK)
                ux, uy, uz = ux / np.float32(BLOCK), uy / np.float32(BLOCK), uz / np.float32(BLOCK)
            ahead = min(_ahead(ux, dx, ix), _ahead(uy, dy, iy), _ahead(uz, dz, iz)) / scale
            beyond = t + ahead * np.float32(0.9999)
            k += max(1, int((beyond - t) / longest))
            while k < end and _middle(lattice, jitter, k) < beyond:
                k += 1
        bounds[r + 1] = found
        following[r] = min(k, end)


@njit(parallel=True, fastmath=True, cache=True)
@no_type_check
def _pack(jitters, lattice, numbers, bounds, index, starts, ends):
    for r in prange(bounds.shape[0] - 1):
        for place in range(bounds[r], bounds[r + 1]):
            k = numbers[r, place - bounds[r]]
            index[place] = r
            starts[place] = _edge(lattice, jitters[r], k)
            ends[place] = _edge(lattice, jitters[r], k + 1)

"""Whole rays in one kernel: march, hash grid, MLPs and quadrature, without gradients.

ROWS rays are processed at a time, each with one sample: when a ray ends, the next one takes its place. So nothing
behind the sample that makes a ray opaque is evaluated, and only a sample's light leaves the cache. A ray's result does
not depend on the others.
"""

import math
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor

from nerf_lightning.nerf.activations import LARGEST_RAW as LARGEST_RAW_DENSITY
from nerf_lightning.nerf.kernels.hash_grid.cpu import FEATURES, encode, level_arrays
from nerf_lightning.nerf.kernels.hash_grid.layout import hash_grid_layout
from nerf_lightning.nerf.kernels.march.cpu import edge, first_from, next_occupied
from nerf_lightning.nerf.kernels.march.grid import BLOCK, MarchState, OccupancyCells, blocks_of, leaps_over
from nerf_lightning.nerf.kernels.mlp.cpu import (
    KINDS,
    ROWS,
    address,
    dtypes,
    packed_words,
    padded_widths,
    round_rows,
    through,
)
from nerf_lightning.nerf.kernels.mlp.vectors import bytes_of
from nerf_lightning.nerf.kernels.render.op import FieldParts
from nerf_lightning.nerf.kernels.threads import over_rows
from nerf_lightning.nerf.types.rays import RayBundle

HALF, ONE, ZERO = np.float32(0.5), np.float32(1.0), np.float32(0.0)
LARGEST_RAW = np.float32(LARGEST_RAW_DENSITY)
"""The field's own bound on the argument of its exponential."""


def render(
    rays: RayBundle,
    field: FieldParts,
    state: MarchState,
    lattice: Float[Tensor, "edges"],
    grid: OccupancyCells,
    least_alpha: float,
    opaque_below: float,
    dtype: torch.dtype,
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"], Float[Tensor, "rays"]]:
    """Return, per ray, sum of w rgb, sum of w, and sum of w t, in the letters of `rendering.quadrature`.

    Args:
        rays: unit directions, scene units.
        field: table and weights.
        state: the start of each ray's march.
        lattice: the intervals (`kernels.march`).
        grid: the cells where the field is evaluated.
        least_alpha: samples less opaque than this count with their density, but not their color.
        opaque_below: a ray ends where its transmittance falls below this.
        dtype: dtype to which the factors of the MLPs' products are rounded: float32 or bfloat16.
    """
    count = rays.near.shape[0]
    out = torch.zeros(count, 3), torch.zeros(count), torch.zeros(count)
    (table,) = arrays_of((field.table,))
    levels = (*level_arrays(field.layout), (0,) * table.shape[1])
    limits = np.float32(field.bias), np.float32(least_alpha), np.float32(opaque_below)
    networks = (*network(field.density_weights, dtype), *network(field.color_weights, dtype))
    march, world, directions = along(rays, field, state, lattice, grid)
    arrays = march, world, directions, field.handed_over(directions.shape[1]), table, levels, networks, limits
    kind = KINDS[dtype]
    over_rows(lambda first, last: _render(kind, first, last, *arrays, arrays_of(out)), count)
    return out


def trial() -> None:
    """Run the kernel once on tiny input; it raises whatever the compiler raises."""
    for dtype in dtypes():
        render(*trial_arguments(), 1e-3, 1e-3, dtype)


def trial_arguments() -> tuple[RayBundle, FieldParts, MarchState, Tensor, OccupancyCells]:
    """Return a ray, a field, and a grid for the ray to march through."""
    one, along = torch.ones(1), torch.tensor([[0.0, 0.0, 1.0]])
    rays = RayBundle(torch.tensor([[0.0, 0.0, -2.0]]), along, one, 3 * one, along)
    cells, aabb = torch.ones(*[BLOCK] * 3, dtype=torch.uint8), torch.tensor([[-1.0] * 3, [1.0] * 3])
    grid = OccupancyCells(aabb, cells, leaps_over(blocks_of(cells)))
    state, lattice = MarchState(one, 3 * one, 0 * one, 0 * one.long()), torch.linspace(1.0, 3.2, 12)
    layout = hash_grid_layout(4, 4, 2, 8)
    weights = [torch.ones(16, 16), torch.ones(16, 16)], [torch.ones(16, 32), torch.ones(3, 16)]
    field = FieldParts(
        aabb,
        torch.zeros(layout.offsets[-1], FEATURES),
        layout,
        0.0,
        *weights,
        lambda rays: torch.ones(len(rays.near), 16),
    )
    return rays, field, state, lattice, grid


def along(
    rays: RayBundle, field: FieldParts, state: MarchState, lattice: Tensor, grid: OccupancyCells
) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...], np.ndarray]:
    """Return rays as arguments of kernels: the march, their place in the world, and features of directions."""
    march = (*grid.in_box(rays), state.enter, state.leave, state.jitter, lattice, grid.cells, grid.leaps)
    world, directions = (rays.origins, rays.directions, field.aabb), field.ray_features(rays)
    return arrays_of(march), arrays_of(world), arrays_of((directions.float(),))[0]


def arrays_of(tensors: tuple[Tensor, ...]) -> tuple[np.ndarray, ...]:
    """Return tensors as arguments of kernels."""
    return tuple(each.detach().contiguous().numpy() for each in tensors)


def network(weights: list[Tensor], dtype: torch.dtype, transposed: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Return an MLP's words, for the forward or the backward pass, and its widths."""
    widths = padded_widths(weights)
    return packed_words([weight.detach().to(dtype) for weight in weights], widths, transposed), np.array(widths)


@njit
@no_type_check
def next_sample(march, r, k):
    """Return the first interval of a ray, from k on, that may hold something; the lattice's end if there is none."""
    o, d, _, leave, jitters, lattice, cells, leaps = march
    return next_occupied(
        *(o[r, 0], o[r, 1], o[r, 2], d[r, 0], d[r, 1], d[r, 2], leave[r], lattice, jitters[r], cells, leaps, k)
    )


@njit
@no_type_check
def interval(march, r, k):
    """Return where an interval of a ray begins and ends."""
    lattice, jitter = march[5], march[4][r]
    return edge(lattice, jitter, k), edge(lattice, jitter, k + 1)


@njit
@no_type_check
def _go_on(march, live, ray, sample_index, light, opaque_below):
    # End rays that are opaque or out of samples, and move the others to their next sample; return how many remain.
    end, s = march[5].shape[0] - 2, 0
    while s < live:
        k = next_sample(march, ray[s], sample_index[s] + 1) if light[s] > opaque_below else end
        if k < end:
            sample_index[s] = k
            s += 1
        else:
            live -= 1
            ray[s], sample_index[s], light[s] = ray[live], sample_index[live], light[live]
    return live


@njit
@no_type_check
def start(march, most, live, waiting, last, ray, sample_index, light):
    """Fill free slots, up to `most`, with rays that meet something; return how many are in use, and the next ray."""
    enter, leave, jitters, lattice = march[2:6]
    while live < most and waiting < last:
        r = waiting
        waiting += 1
        if enter[r] < leave[r]:
            k = next_sample(march, r, first_from(lattice, jitters[r], 0, enter[r]))
            if k < lattice.shape[0] - 2:
                ray[live], sample_index[live], light[live] = r, k, ONE
                live += 1
    return live, waiting


@njit
@no_type_check
def locate(world, r, t, points, s):
    """Write the position of a ray at a distance, with the field's box as the unit cube."""
    origins, directions, aabb = world
    for axis in range(3):
        at = origins[r, axis] + t * directions[r, axis]
        points[s, axis] = (at - aabb[0, axis]) / (aabb[1, axis] - aabb[0, axis])


@njit
@no_type_check
def fill(inputs, row, hidden, flat, begin, directions, r):
    """Write a sample's inputs of the color MLP: the density MLP's features, and features of the ray's direction."""
    # One number at a time: with slices, numba would spend seconds compiling the formatting of an error message.
    for c in range(hidden):
        inputs[row, c] = flat[begin + c]
    for c in range(directions.shape[1]):
        inputs[row, hidden + c] = directions[r, c]


@njit
@no_type_check
def is_inside(points, s):
    """Return whether a sample is in the unit cube, outside of which space is empty."""
    x, y, z = points[s, 0], points[s, 1], points[s, 2]
    return ZERO <= x <= ONE and ZERO <= y <= ONE and ZERO <= z <= ONE


@njit
@no_type_check
def _add_colors(kind, count, inputs, words, packed, dims, sums, owner, weight, foreground):
    x, y = address(words), address(sums)
    round_rows(kind, address(inputs), 4 * dims[0], x, bytes_of(kind) * dims[0], ROWS, dims[0])
    through(kind, x, address(packed), dims, y, y)
    flat, outer = sums.reshape(-1), dims[-1]
    for i in range(count):
        for c in range(3):
            foreground[owner[i], c] += weight[i] / (ONE + math.exp(-flat[i * outer + c]))


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def _render(kind, first, last, march, world, directions, hidden, table, levels, networks, limits, out):
    resolutions, offsets, hashed, mask, lanes = levels
    density_words, dims, color_words, color_dims = networks
    bias, least_alpha, opaque_below = limits
    foreground, opacity, depth = out
    # The active rays: index, current interval, and transmittance.
    ray, sample_index, light = np.zeros(ROWS, np.int64), np.zeros(ROWS, np.int64), np.zeros(ROWS, np.float32)
    begin, stop = light.copy(), light.copy()
    points, features = np.zeros((ROWS, 3), np.float32), np.zeros((ROWS, dims[0]), np.float32)
    size, sums = bytes_of(kind), np.zeros((ROWS, dims.max()), np.float32)
    words = np.zeros((ROWS, dims[:-1].sum() * size // 4), np.int32)
    flat, outer = sums.reshape(-1), dims[-1]
    # The samples whose colors are computed together.
    inputs, owner, weight = np.zeros((ROWS, color_dims[0]), np.float32), np.zeros(ROWS, np.int64), light.copy()
    between = np.zeros((ROWS, color_dims[:-1].sum() * size // 4), np.int32)
    colors = np.zeros((ROWS, color_dims.max()), np.float32)
    live, waiting, asked = 0, first, 0
    while True:
        live = _go_on(march, live, ray, sample_index, light, opaque_below)
        live, waiting = start(march, ROWS, live, waiting, last, ray, sample_index, light)
        if live == 0:
            break
        for s in range(live):
            begin[s], stop[s] = interval(march, ray[s], sample_index[s])
            locate(world, ray[s], HALF * (begin[s] + stop[s]), points, s)
        encode(0, live, table, points, resolutions, offsets, hashed, mask, lanes, features)
        x, y = address(words), address(sums)
        round_rows(kind, address(features), 4 * dims[0], x, size * dims[0], ROWS, dims[0])
        through(kind, x, address(density_words), dims, y, y)
        for s in range(live):
            if not is_inside(points, s):
                continue
            r, density = ray[s], math.exp(min(flat[s * outer] + bias, LARGEST_RAW))
            alpha = -math.expm1(-density * (stop[s] - begin[s]))
            w = light[s] * alpha
            light[s] -= w
            opacity[r] += w
            depth[r] += w * HALF * (begin[s] + stop[s])
            if alpha > least_alpha:
                fill(inputs, asked, hidden, flat, s * outer, directions, r)
                owner[asked], weight[asked] = r, w
                asked += 1
            if asked == ROWS:
                _add_colors(kind, asked, inputs, between, color_words, color_dims, colors, owner, weight, foreground)
                asked = 0
    _add_colors(kind, asked, inputs, between, color_words, color_dims, colors, owner, weight, foreground)

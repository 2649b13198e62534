"""Whole rays in one kernel per pass, with gradients: march, hash grid, MLPs and quadrature.

As in `cpu.py`, ROWS samples are processed at a time, but of fewer rays: each contributes several consecutive ones, more
if few rays are left. What the backward pass needs is kept block by block. It takes the blocks from last to first, so
that the farthest samples of each ray come first, and accumulates what is behind each.

Letters as in `kernels.ragged.op`. The samples' positions along the rays have no gradient.
"""

from itertools import pairwise
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor

from nerf_lightning.nerf.kernels.hash_grid import cpu as hash_grid
from nerf_lightning.nerf.kernels.hash_grid.cpu import encode, level_arrays
from nerf_lightning.nerf.kernels.hash_grid.op import table_gradient
from nerf_lightning.nerf.kernels.march.grid import MarchState, OccupancyCells
from nerf_lightning.nerf.kernels.mlp.cpu import (
    KINDS,
    ROWS,
    address,
    back_through,
    dtypes,
    padded_widths,
    round_rows,
    through,
    unpadded,
    words_of,
)
from nerf_lightning.nerf.kernels.mlp.vectors import bytes_of
from nerf_lightning.nerf.kernels.render.compositing import (
    BACK,
    COLOR,
    DISTANCE,
    LIGHT,
    WEIGHT,
    absorb,
    new_rooms,
    shade,
)
from nerf_lightning.nerf.kernels.render.cpu import (
    along,
    arrays_of,
    fill,
    interval,
    locate,
    network,
    next_sample,
    start,
    trial_arguments,
)
from nerf_lightning.nerf.kernels.render.op import FieldParts
from nerf_lightning.nerf.kernels.render.workspace import Workspace, give_back, take_workspace
from nerf_lightning.nerf.kernels.threads import in_parallel, num_threads, parts_of
from nerf_lightning.nerf.types.rays import RayBundle

HALF, ONE, ZERO = np.float32(0.5), np.float32(1.0), np.float32(0.0)
SLOTS = 64
"""Number of rays processed at a time. Consecutive samples are close in the tables, but those behind an opaque one are
evaluated in vain."""
SPARE_ROWS, FEWEST_RAYS = 8 * ROWS, 64


def render(
    rays: RayBundle,
    field: FieldParts,
    state: MarchState,
    lattice: Float[Tensor, "edges"],
    grid: OccupancyCells,
    opaque_below: float,
    dtype: torch.dtype,
    samples_per_ray: float,
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"], Float[Tensor, "rays"], int]:
    """Return, per ray, sum of w rgb, sum of w, and sum of w t; and how many samples were evaluated.

    Gradients flow to the field's table and weights. The arguments are those of `cpu.render`; every sample counts with
    its color.

    Args:
        rays: unit directions, scene units.
        field: table and weights.
        state: the start of each ray's march.
        lattice: the intervals (`kernels.march`).
        grid: the cells where the field is evaluated.
        opaque_below: a ray ends where its transmittance falls below this.
        dtype: dtype to which the factors of the MLPs' products are rounded: float32 or bfloat16.
        samples_per_ray: approximate number of samples per ray.
    """
    call = _Call(rays, field, state, lattice, grid, opaque_below, dtype, samples_per_ray)
    out = _WholeRays.apply(call, field.table, *field.density_weights, *field.color_weights)
    return *out, call.num_evaluated


def trial() -> None:
    """Run the kernels once on tiny input, in the default precision of training here."""
    rays, field, state, lattice, grid = trial_arguments()
    field.table.requires_grad_()
    light, opacity, depth, _ = render(rays, field, state, lattice, grid, 1e-3, dtypes()[-1], 1.0)
    (light.sum() + opacity.sum() + depth.sum()).backward()


class _Call:
    """All that a pass needs besides the tensors with gradients."""

    def __init__(
        self,
        rays: RayBundle,
        field: FieldParts,
        state: MarchState,
        lattice: Tensor,
        grid: OccupancyCells,
        opaque_below: float,
        dtype: torch.dtype,
        samples_per_ray: float,
    ):
        self.field, self.kind, self.dtype = field, KINDS[dtype], dtype
        self.march, self.world, self.directions = along(rays, field, state, lattice, grid)
        self.hidden = field.handed_over(self.directions.shape[1])
        self.limits = np.float32(field.bias), np.float32(opaque_below), self.hidden
        self.rays, self.samples_per_ray, self.num_evaluated = rays.near.shape[0], samples_per_ray, 0
        self.parts = parts_of(self.rays, num_threads(), FEWEST_RAYS)
        self.workspaces: list[Workspace] = []
        self.used: list[int] = []

    def networks(self, density: list[Tensor], color: list[Tensor], transposed: bool) -> tuple[np.ndarray, ...]:
        """Return the words and widths of both MLPs."""
        return (*network(density, self.dtype, transposed), *network(color, self.dtype, transposed))

    def see(self, table: Tensor, density: list[Tensor], color: list[Tensor], out: tuple[Tensor, ...]) -> None:
        """Render, and keep what the backward pass needs."""
        of_field = arrays_of((table,))[0], (*level_arrays(self.field.layout), (0,) * table.shape[1])
        given = self.march, self.world, self.directions, *of_field, self.networks(density, color, False), self.limits
        of_density, of_color = (words_of(sum(padded_widths(weights)[:-1]), self.dtype) for weights in (density, color))

        def part(bounds: tuple[int, int]) -> tuple[Workspace, int, int]:
            rows = SPARE_ROWS + ROWS * (int(1.25 * self.samples_per_ray * (bounds[1] - bounds[0])) // ROWS)
            while True:
                workspace = take_workspace(rows, (of_density, of_color))
                used, evaluated = _see(self.kind, *bounds, *given, workspace.arrays(), arrays_of(out))
                if used * ROWS <= workspace.rows:
                    return workspace, used, evaluated
                rows = 2 * workspace.rows
                for each in out:
                    each[bounds[0] : bounds[1]] = 0.0

        found = in_parallel(part, self.parts)
        self.workspaces, self.used = [workspace for workspace, _, _ in found], [used for _, used, _ in found]
        self.num_evaluated = sum(evaluated for _, _, evaluated in found)

    def go_back(
        self, density: list[Tensor], color: list[Tensor], grads: tuple[Tensor, ...]
    ) -> tuple[list[Tensor], Tensor, Tensor]:
        """Return the gradients of the weights, and all points with the gradients of their features."""
        if not self.workspaces:
            raise RuntimeError("This rendering has been sent back already, and keeps nothing for a second time.")
        networks, arrays = self.networks(density, color, True), arrays_of(grads)
        widths = padded_widths(density), padded_widths(color)
        counts = [sum(a * b for a, b in pairwise(each)) for each in widths]
        sums, ends = torch.zeros(len(self.parts), sum(counts)), np.cumsum(self.used) * ROWS
        points, features = torch.empty(int(ends[-1]), 3), torch.empty(int(ends[-1]), widths[0][0])

        def part(number: int) -> None:
            workspace, end, count = self.workspaces[number], int(ends[number]), self.used[number] * ROWS
            totals = sums[number, : counts[0]].numpy(), sums[number, counts[0] :].numpy()
            slope = np.float32(self.field.least_slope)
            given = self.parts[number], self.used[number], self.hidden, networks, slope, arrays, workspace.arrays()
            _go_back(self.kind, *given, features[end - count : end].numpy(), *totals)
            points[end - count : end] = workspace.points[:count]

        in_parallel(part, range(len(self.parts)))
        total = sums.sum(dim=0)
        of_density = unpadded(total[: counts[0]], density, widths[0])
        of_color = unpadded(total[counts[0] :], color, widths[1])
        give_back(self.workspaces)
        self.workspaces = []
        return [*of_density, *of_color], points, features


class _WholeRays(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, call: _Call, table: Tensor, *weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        layers = len(call.field.density_weights)
        out = torch.zeros(call.rays, 3), torch.zeros(call.rays), torch.zeros(call.rays)
        call.see(table, list(weights[:layers]), list(weights[layers:]), out)
        ctx.call, ctx.layers = call, layers
        ctx.save_for_backward(table, *weights)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Any, ...]:
        table, *weights = ctx.saved_tensors
        of_weights, points, features = ctx.call.go_back(weights[: ctx.layers], weights[ctx.layers :], grads)
        of_table = None
        if ctx.needs_input_grad[1]:
            of_table = table_gradient(table, points, features, ctx.call.field.layout, hash_grid)
        return None, of_table, *of_weights


@njit
@no_type_check
def _take(march, world, live, ray, sample_index, slots, owners, lengths, distances, points):
    # Give each active ray its next samples, as many as there is room for; return the number of samples.
    each, end, count = ROWS // live, march[5].shape[0] - 2, 0
    for s in range(live):
        r, k = ray[s], sample_index[s]
        for _ in range(each):
            if k >= end:
                break
            begin, stop = interval(march, r, k)
            t = HALF * (begin + stop)
            locate(world, r, t, points, count)
            slots[count], owners[count] = s, r
            lengths[count], distances[count] = stop - begin, t
            count += 1
            k = next_sample(march, r, k + 1)
        sample_index[s] = k
    return count


@njit
@no_type_check
def _composite(count, alpha, opaque_below, slots, light, owners, distances, numbers, opacity, depth):
    # Ray by ray from front to back; samples behind an opaque one get no owner. Return how many have one.
    seen = 0
    for i in range(count):
        s = slots[i]
        if light[s] <= opaque_below:
            owners[i] = -1
            continue
        seen += 1
        w = light[s] * alpha[i]
        light[s] -= w
        numbers[i, LIGHT], numbers[i, WEIGHT], numbers[i, DISTANCE] = light[s], w, distances[i]
        opacity[owners[i]] += w
        depth[owners[i]] += w * distances[i]
    return seen


@njit
@no_type_check
def _end(live, end, opaque_below, ray, sample_index, light):
    # Drop rays that are opaque or out of samples; return how many remain.
    s = 0
    while s < live:
        if light[s] > opaque_below and sample_index[s] < end:
            s += 1
        else:
            live -= 1
            ray[s], sample_index[s], light[s] = ray[live], sample_index[live], light[live]
    return live


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def _see(kind, first, last, march, world, directions, table, levels, networks, limits, room, out):
    resolutions, offsets, hashed, mask, lanes = levels
    density_words, dims, color_words, color_dims = networks
    bias, opaque_below, hidden = limits
    foreground, opacity, depth = out
    all_owners, all_numbers, all_points, density_kept, color_kept = room
    ray, sample_index, light = np.zeros(ROWS, np.int64), np.zeros(ROWS, np.int64), np.zeros(ROWS, np.float32)
    slots, features = np.zeros(ROWS, np.int64), np.zeros((ROWS, dims[0]), np.float32)
    lengths, distances, rooms = np.zeros(ROWS, np.float32), np.zeros(ROWS, np.float32), new_rooms()
    inputs = np.zeros((ROWS, color_dims[0]), np.float32)
    sums = np.zeros((ROWS, max(dims.max(), color_dims.max())), np.float32)
    flat = sums.reshape(-1)
    size = bytes_of(kind)
    stride, color_stride = size * dims[:-1].sum(), size * color_dims[:-1].sum()
    live, waiting, block, evaluated, end = 0, first, 0, 0, march[5].shape[0] - 2
    while True:
        live, waiting = start(march, SLOTS, live, waiting, last, ray, sample_index, light)
        if live == 0:
            return block, evaluated
        if (block + 1) * ROWS > all_owners.shape[0]:
            return block + 1, evaluated
        rows = slice(block * ROWS, (block + 1) * ROWS)
        owners, numbers, points = all_owners[rows], all_numbers[rows], all_points[rows]
        count = _take(march, world, live, ray, sample_index, slots, owners, lengths, distances, points)
        owners[count:], points[count:] = -1, HALF
        encode(0, count, table, points, resolutions, offsets, hashed, mask, lanes, features)
        x, y = address(density_kept) + block * ROWS * stride, address(sums)
        round_rows(kind, address(features), 4 * dims[0], x, size * dims[0], ROWS, dims[0])
        through(kind, x, address(density_words), dims, y, y)
        absorb(count, flat, dims[-1], bias, False, ZERO, lengths, distances, points, numbers, rooms)
        evaluated += _composite(count, rooms[2], opaque_below, slots, light, owners, distances, numbers, opacity, depth)
        for i in range(count):
            fill(inputs, i, hidden, flat, i * dims[-1], directions, ray[slots[i]])
        x = address(color_kept) + block * ROWS * color_stride
        round_rows(kind, address(inputs), 4 * color_dims[0], x, size * color_dims[0], ROWS, color_dims[0])
        through(kind, x, address(color_words), color_dims, y, y)
        shade(count, flat, color_dims[-1], owners, numbers, rooms, foreground)
        live = _end(live, end, opaque_below, ray, sample_index, light)
        block += 1


@njit
@no_type_check
def _composite_back(owners, numbers, first, least_slope, grads, suffix_sums, outer, flat, of_density):
    # Gradients of a block's raw colors, contiguous in `flat`, and of its raw densities; from back to front.
    of_light, of_opacity, of_depth = grads
    flat[: ROWS * outer] = ZERO
    for i in range(ROWS - 1, -1, -1):
        r = owners[i]
        of_density[i] = ZERO
        if r < 0:
            continue
        w = numbers[i, WEIGHT]
        g = of_opacity[r] + of_depth[r] * numbers[i, DISTANCE]
        for c in range(3):
            shade, toward = numbers[i, COLOR + c], of_light[r, c] * w
            g += of_light[r, c] * shade
            slope = shade * (ONE - shade)
            if toward * (shade - HALF) > ZERO:  # a step goes against the gradient: back from black or full
                slope = max(slope, least_slope)
            flat[i * outer + c] = toward * slope
        of_density[i] = numbers[i, BACK] * (numbers[i, LIGHT] * g - suffix_sums[r - first])
        suffix_sums[r - first] += w * g


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def _go_back(kind, bounds, blocks, hidden, networks, least_slope, grads, room, features, of_density, of_color):
    density_words, dims, color_words, color_dims = networks
    owners, numbers, _, density_kept, color_kept = room
    size, widest = bytes_of(kind), max(dims.max(), color_dims.max())
    stride, color_stride = size * dims[:-1].sum(), size * color_dims[:-1].sum()
    sums, words = np.zeros((ROWS, widest), np.float32), np.zeros((3, ROWS, widest * size // 4), np.int32)
    passed, raw = np.zeros((ROWS, color_dims[0]), np.float32), np.zeros(ROWS, np.float32)
    suffix_sums = np.zeros(bounds[1] - bounds[0], np.float32)
    flat, next_room, outer, color_outer = sums.reshape(-1), size * ROWS * widest, dims[-1], color_dims[-1]
    for block in range(blocks - 1, -1, -1):
        rows = slice(block * ROWS, (block + 1) * ROWS)
        _composite_back(owners[rows], numbers[rows], bounds[0], least_slope, grads, suffix_sums, color_outer, flat, raw)
        y, dy = address(sums), address(words)
        round_rows(kind, y, 4 * color_outer, dy, size * color_outer, ROWS, color_outer)
        back_through(
            kind, address(color_kept) + block * ROWS * color_stride, address(color_words), color_dims, dy,
            y, dy + next_room, dy + 2 * next_room, address(of_color), True, address(passed),
        )  # fmt: skip
        for i in range(ROWS):
            for c in range(outer):
                flat[i * outer + c] = passed[i, c] if c < hidden else ZERO
            flat[i * outer] += raw[i]
        round_rows(kind, y, 4 * outer, dy, size * outer, ROWS, outer)
        back_through(
            kind, address(density_kept) + block * ROWS * stride, address(density_words), dims, dy,
            y, dy + next_room, dy + 2 * next_room, address(of_density), True,
            address(features) + 4 * block * ROWS * dims[0],
        )  # fmt: skip

"""Whole rays with equal numbers of samples in one kernel per pass: hash grid, MLPs, quadrature, and their gradients.

Some rays go forward together, and blocks of ROWS samples go from positions to light while they are in the cache. The
backward pass takes the blocks from last to first, so that the farthest samples of each ray come first, and accumulates
what is behind each.

Letters as in `rendering.quadrature`. The samples' positions along the rays have no gradient.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor

from nerf_lightning.nerf.kernels.hash_grid import cpu as hash_grid
from nerf_lightning.nerf.kernels.hash_grid.cpu import encode, level_arrays, write_point_gradient
from nerf_lightning.nerf.kernels.hash_grid.layout import hash_grid_layout
from nerf_lightning.nerf.kernels.hash_grid.op import table_gradient
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
from nerf_lightning.nerf.kernels.mlp.vectors import LANES, bytes_of, round_vector
from nerf_lightning.nerf.kernels.render.compositing import BACK, COLOR, LIGHT, SHARE, WEIGHT, absorb, new_rooms, shade
from nerf_lightning.nerf.kernels.render.cpu import arrays_of, network
from nerf_lightning.nerf.kernels.render.op import FieldParts
from nerf_lightning.nerf.kernels.render.workspace import NUMBERS, Workspace, give_back, take_workspace
from nerf_lightning.nerf.kernels.threads import in_parallel, num_threads, parts_of
from nerf_lightning.nerf.types.rays import RayBundle

HALF, ONE, TWO, QUARTER, ZERO = (np.float32(each) for each in (0.5, 1.0, 2.0, 0.25, 0.0))
FEWEST_RAYS = 32
ABREAST = 128
"""Rays that go forward together, a sample each, until they are opaque; those of a picture share the grid's cells."""
LEAST_WEIGHT = np.float32(1e-4)
"""If rays may end early, samples of less weight have no color."""
COPY = np.float32(0)
"""The kind with which `round_vector` rounds to float32, that is, copies."""


def render(
    rays: RayBundle,
    edges: Float[Tensor, "rays edges"],
    field: FieldParts,
    dtype: torch.dtype,
    closed: bool,
    whole_from: float,
    opaque_below: float,
) -> tuple[Float[Tensor, "rays samples"], Float[Tensor, "rays 3"]]:
    """Return the weights of all samples, and per ray the sum of w rgb (0 for a field without colors).

    Gradients flow to the field's table and weights, to the features of directions, and to the rays' origins and
    directions.

    Args:
        rays: unit directions, scene units.
        edges: the intervals, at whose midpoints the field is evaluated.
        field: table and weights.
        dtype: dtype to which the factors of the MLPs' products are rounded: float32 or bfloat16.
        closed: whether the last interval absorbs all remaining light.
        whole_from: `rendering.near_gradients`; 0: gradients are whole everywhere.
        opaque_below: a sample behind which less light is left absorbs it all, and ends its ray; 0: none does.
    """
    features = field.ray_features(rays) if field.color_weights else torch.zeros(len(edges), 0)
    given = rays.origins, rays.directions, features, field.table, *field.density_weights, *field.color_weights
    keep = torch.is_grad_enabled() and any(each.requires_grad for each in given)
    return _DenseRays.apply(_Call(edges, field, dtype, closed, whole_from, opaque_below, keep), *given)


def trial() -> None:
    """Run the kernels once on tiny input; it raises whatever the compiler raises.

    In the default precision of training here: those of the other precision are compiled by its first step.
    """
    origins, along = torch.zeros(2, 3, requires_grad=True), torch.tensor([[0.0, 0.0, 1.0]]).expand(2, 3)
    rays = RayBundle(origins, along, torch.zeros(2), torch.ones(2), along)
    aabb, edges = torch.tensor([[-1.0] * 3, [1.0] * 3]), torch.linspace(0.0, 1.0, 4).expand(2, 4)
    for features in (2, 4):
        layout = hash_grid_layout(2, 4, 2, 8)
        table = torch.zeros(layout.offsets[-1], features, requires_grad=True)
        density = [torch.ones(16, 2 * features, requires_grad=True), torch.ones(16, 16, requires_grad=True)]
        color = [torch.ones(16, 32, requires_grad=True), torch.ones(3, 16, requires_grad=True)]
        field = FieldParts(
            aabb, table, layout, 0.0, density, color, lambda rays: torch.ones(len(rays.near), 16), contracted=True
        )
        weights, foreground = render(rays, edges, field, dtypes()[-1], False, 1.0, 0.0)
        (weights.sum() + foreground.sum()).backward()
        with torch.no_grad():
            render(rays, edges, field, dtypes()[-1], False, 0.0, 1e-3)


@dataclass
class _Call:
    """All that a pass needs besides the tensors with gradients."""

    edges: Tensor
    field: FieldParts
    dtype: torch.dtype
    closed: bool
    whole_from: float
    opaque_below: float
    keep: bool
    """Whether a backward pass follows."""

    def __post_init__(self) -> None:
        self.kind, self.edges = KINDS[self.dtype], self.edges.detach().float().contiguous()
        self.rays, self.samples = len(self.edges), self.edges.shape[1] - 1
        self.parts = parts_of(self.rays, num_threads(), FEWEST_RAYS)
        self.saved: list[tuple[Workspace, int]] = []  # workspace of each part, with its number of samples
        # To the unit cube, or to the cube inscribed in the unit ball (`geometry.contraction`).
        low, high = self.field.aabb
        side, shift = high - low, 0.0
        if self.field.contracted:
            side, shift = side * (3**0.5 / 2), 3**-0.5
        self.scale, self.offset = 1.0 / side, -low / side - shift

    def networks(self, weights: list[Tensor], transposed: bool) -> tuple[np.ndarray, ...]:
        """Return the words and widths of both MLPs; no widths if there are no colors."""
        density, color = self.split(weights)
        none = np.zeros(0, np.int32), np.zeros(0, np.int64)
        return (*network(density, self.dtype, transposed), *(network(color, self.dtype, transposed) if color else none))

    def split(self, weights: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        """Return the weights of the density MLP, and of the color MLP."""
        layers = len(self.field.density_weights)
        return weights[:layers], weights[layers:]

    def space(self, origins: Tensor, directions: Tensor) -> tuple[Any, ...]:
        """Return the rays in the coordinates before contraction, their intervals, and whether space is contracted."""
        scaled = origins.float() * self.scale + self.offset, directions.float() * self.scale
        return (*arrays_of((*scaled, self.edges)), self.field.contracted)

    def grid(self, table: Tensor) -> tuple[Any, ...]:
        """Return the arguments for looking up features."""
        return arrays_of((table,))[0], *level_arrays(self.field.layout), (0,) * table.shape[1]

    def forward(self, origins: Tensor, directions: Tensor, features: Tensor, table: Tensor, *learnt: Tensor) -> Any:
        """Render, and keep what the backward pass needs."""
        weights = list(learnt)
        density, color = self.split(weights)
        out = torch.zeros(self.rays, self.samples), torch.zeros(self.rays, 3)
        words = [words_of(sum(padded_widths(each)[:-1]), self.dtype) if each else 0 for each in (density, color)]
        space, grid, networks = self.space(origins, directions), self.grid(table), self.networks(weights, False)
        limits = (np.float32(each) for each in (self.field.bias, self.whole_from, self.opaque_below))
        numbers = *limits, self.closed, self.field.handed_over(features.shape[1])
        given, shown = (space, arrays_of((features.float(),))[0], grid, networks, numbers), arrays_of(out)

        def keep(bounds: tuple[int, int]) -> tuple[Workspace, int]:
            blocks = -(-(bounds[1] - bounds[0]) * self.samples // ROWS)
            workspace = take_workspace(blocks * ROWS, (words[0], words[1]))
            return workspace, _forward(self.kind, *bounds, *given, workspace.arrays(), shown)

        if self.keep:
            self.saved = in_parallel(keep, self.parts)
        else:
            in_parallel(lambda bounds: _show(self.kind, *bounds, *given, shown), self.parts)
        return out

    def backward(
        self, wants_rays: bool, rays: tuple[Tensor, ...], table: Tensor, weights: list[Tensor], grads: Any
    ) -> tuple[list[Tensor], Tensor, Tensor, list[Tensor]]:
        """Return the gradients of rays, all points and the gradients of their features, and those of the weights.

        Args:
            wants_rays: whether origins and directions need gradients; those of the shared features are cheap.
            rays: origins, directions, features.
            table: table of the grid.
            weights: weights of both MLPs.
            grads: gradients of what `forward` returned.
        """
        if not self.saved:
            raise RuntimeError("This rendering has been sent back already, and keeps nothing for a second time.")
        density, color = self.split(weights)
        widths = padded_widths(density), padded_widths(color) if color else []
        counts = [sum(a * b for a, b in pairwise(each)) for each in widths]
        sums = torch.zeros(len(self.parts), sum(counts))
        found, ends = len(self.field.layout.resolutions) * table.shape[1], np.cumsum([used for _, used in self.saved])
        points, of_points = torch.empty(int(ends[-1]), 3), torch.empty(int(ends[-1]), found)
        of_rays = [torch.zeros(each.shape) for each in rays]
        space, grid, networks = self.space(*rays[:2]), self.grid(table), self.networks(weights, transposed=True)
        numbers = np.float32(self.field.least_slope), self.field.handed_over(rays[2].shape[1]), wants_rays
        out, of_light = arrays_of((points, of_points, *of_rays)), arrays_of(tuple(each.float() for each in grads))

        def part(number: int) -> None:
            totals = sums[number, : counts[0]].numpy(), sums[number, counts[0] :].numpy()
            workspace, used = self.saved[number]
            given = space, grid, networks, numbers, of_light, workspace.arrays(), out, totals
            _backward(self.kind, *self.parts[number], ends[number] - used, used, *given)

        in_parallel(part, range(len(self.parts)))
        total = sums.sum(dim=0)
        of_weights = unpadded(total[: counts[0]], density, widths[0])
        of_weights += unpadded(total[counts[0] :], color, widths[1]) if color else []
        give_back([workspace for workspace, _ in self.saved])
        self.saved = []
        of_rays[0] *= self.scale
        of_rays[1] *= self.scale
        return of_rays, points, of_points, of_weights


class _DenseRays(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, call: _Call, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        ctx.call = call
        if call.keep:
            ctx.save_for_backward(*inputs)
        return call.forward(*inputs)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Any, ...]:
        *rays, table = ctx.saved_tensors[:4]
        weights = list(ctx.saved_tensors[4:])
        wants_rays = any(ctx.needs_input_grad[1:3])
        of_rays, points, of_points, of_weights = ctx.call.backward(wants_rays, tuple(rays), table, weights, grads)
        of_table = None
        if ctx.needs_input_grad[4]:
            of_table = table_gradient(table, points, of_points, ctx.call.field.layout, hash_grid)
        return None, *of_rays, of_table, *of_weights


@njit
@no_type_check
def _next_samples(first, last, samples, cursor, lights, block):
    # Fill a block, and return how many samples it has, and where the next one begins. The rays that go forward together
    # contribute their first samples, then their second ones, and so on, as far as light gets through.
    leftmost, k, c = cursor
    count, width = 0, min(ABREAST, last - leftmost)
    while count < ROWS and leftmost < last:
        r = leftmost + c
        block[0][count], block[1][count] = r, k
        count += lights[r - first] > ZERO
        c += 1
        if c == width:
            c, k = 0, k + 1
        if k == samples:
            k, leftmost = 0, leftmost + ABREAST
            width = min(ABREAST, last - leftmost)
    return count, (leftmost, k, c)


@njit(fastmath={"contract"}, error_model="numpy")
@no_type_check
def _locate(space, count, block, points):
    # Distance, length and position (in the unit cube) of a block's samples.
    origins, directions, edges, contracted = space
    owner, sample, t, delta, x, y, z = block
    for i in range(count):
        r, k = owner[i], sample[i]
        begin, end = edges[r, k], edges[r, k + 1]
        middle = HALF * (begin + end)
        t[i], delta[i] = middle, end - begin
        x[i] = origins[r, 0] + middle * directions[r, 0]
        y[i] = origins[r, 1] + middle * directions[r, 1]
        z[i] = origins[r, 2] + middle * directions[r, 2]
    for i in range(count):
        factor, shift = ONE, ZERO
        if contracted:
            norm = max(np.sqrt(x[i] * x[i] + y[i] * y[i] + z[i] * z[i]), ONE)
            factor, shift = (TWO - ONE / norm) / norm * QUARTER, HALF
        points[i, 0], points[i, 1], points[i, 2] = x[i] * factor + shift, y[i] * factor + shift, z[i] * factor + shift


@njit
@no_type_check
def _composite(count, first, closed, opaque_below, block, alpha, lights, numbers, weights):
    # From front to back; `lights` is the light left behind the last sample of each ray.
    last = weights.shape[1] - 1
    for i in range(count):
        r, k = block[0][i], block[1][i]
        light = lights[r - first]
        w = light * alpha[i]
        if light - w < opaque_below or (closed and k == last):
            w, numbers[i, BACK] = light, ZERO
        lights[r - first] = light - w
        numbers[i, LIGHT], numbers[i, WEIGHT], weights[r, k] = light - w, w, w


@njit
@no_type_check
def _copy_numbers(source, target, count):
    # Whole vectors first.
    done = 0
    while count - done >= LANES:
        round_vector(COPY, source + 4 * done, target + 4 * done)
        done += LANES
    return done


@njit
@no_type_check
def _color_inputs(i, r, hidden, flat, outer, of_rays, inputs, row):
    # A sample's features from the density MLP, followed by what all samples of its ray share.
    shared, to = of_rays.shape[1], address(inputs) + 4 * row * inputs.shape[1]
    for c in range(_copy_numbers(address(flat) + 4 * i * outer, to, hidden), hidden):
        inputs[row, c] = flat[i * outer + c]
    for c in range(_copy_numbers(address(of_rays) + 4 * r * shared, to + 4 * hidden, shared), shared):
        inputs[row, hidden + c] = of_rays[r, c]


@njit
@no_type_check
def _new_block():
    whole, floats = np.zeros((2, ROWS), np.int64), np.zeros((5, ROWS), np.float32)
    return whole[0], whole[1], floats[0], floats[1], floats[2], floats[3], floats[4]


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def _forward(kind, first, last, space, of_rays, grid, networks, numbers_of_call, saved, out):
    table, resolutions, offsets, hashed, mask, lanes = grid
    density_words, dims, color_words, color_dims = networks
    bias, whole_from, opaque_below, closed, hidden = numbers_of_call
    places, all_numbers, all_points, density_kept, color_kept = saved
    weights, foreground = out
    samples, colored, size = space[2].shape[1] - 1, color_dims.shape[0] > 0, bytes_of(kind)
    block, rooms, features = _new_block(), new_rooms(), np.zeros((ROWS, dims[0]), np.float32)
    inputs = np.zeros((ROWS, color_dims[0] if colored else 0), np.float32)
    sums = np.zeros((ROWS, max(dims.max(), color_dims.max() if colored else 0)), np.float32)
    lights, cursor, start = np.ones(last - first, np.float32), (first, 0, 0), 0
    flat, outer = sums.reshape(-1), dims[-1]
    stride, color_stride = size * dims[:-1].sum(), size * color_dims[:-1].sum()
    while cursor[0] < last:
        count, cursor = _next_samples(first, last, samples, cursor, lights, block)
        if count == 0:
            break
        numbers, points = all_numbers[start : start + ROWS], all_points[start : start + ROWS]
        for i in range(count):
            places[start + i] = (block[0][i] - first) * samples + block[1][i]
        _locate(space, count, block, points)
        encode(0, count, table, points, resolutions, offsets, hashed, mask, lanes, features)
        x, y = address(density_kept) + start * stride, address(sums)
        round_rows(kind, address(features), 4 * dims[0], x, size * dims[0], ROWS, dims[0])
        through(kind, x, address(density_words), dims, y, y)
        absorb(count, flat, outer, bias, space[3], whole_from, block[3], block[2], points, numbers, rooms)
        _composite(count, first, closed, opaque_below, block, rooms[2], lights, numbers, weights)
        if colored:
            for i in range(count):
                _color_inputs(i, block[0][i], hidden, flat, outer, of_rays, inputs, i)
            x = address(color_kept) + start * color_stride
            round_rows(kind, address(inputs), 4 * color_dims[0], x, size * color_dims[0], ROWS, color_dims[0])
            through(kind, x, address(color_words), color_dims, y, y)
            shade(count, flat, color_dims[-1], block[0], numbers, rooms, foreground)
        start += count
    return start


@njit
@no_type_check
def _show_colors(kind, count, hues, color_words, color_dims, rooms, foreground):
    # Add the weighted colors of waiting samples to their rays.
    owners, inputs, numbers, words, sums = hues
    x, y = address(words), address(sums)
    round_rows(kind, address(inputs), 4 * color_dims[0], x, bytes_of(kind) * color_dims[0], ROWS, color_dims[0])
    through(kind, x, address(color_words), color_dims, y, y)
    shade(count, sums.reshape(-1), color_dims[-1], owners, numbers, rooms, foreground)


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def _show(kind, first, last, space, of_rays, grid, networks, numbers_of_call, out):
    # As `_forward`, without gradients: rays end where they are opaque, and samples with some weight wait for their
    # colors until there is a block of them.
    table, resolutions, offsets, hashed, mask, lanes = grid
    density_words, dims, color_words, color_dims = networks
    bias, _, opaque_below, closed, hidden = numbers_of_call
    weights, foreground = out
    samples, colored, size = space[2].shape[1] - 1, color_dims.shape[0] > 0, bytes_of(kind)
    block, rooms, points = _new_block(), new_rooms(), np.zeros((ROWS, 3), np.float32)
    numbers, features = np.zeros((ROWS, NUMBERS), np.float32), np.zeros((ROWS, dims[0]), np.float32)
    sums, words = np.zeros((ROWS, dims.max()), np.float32), np.zeros(ROWS * size * dims[:-1].sum() // 4, np.int32)
    lights = np.ones(last - first, np.float32)
    hues = (
        np.zeros(ROWS, np.int64),
        np.zeros((ROWS, color_dims[0] if colored else 0), np.float32),
        np.zeros((ROWS, NUMBERS), np.float32),
        np.zeros(ROWS * size * (color_dims[:-1].sum() if colored else 0) // 4, np.int32),
        np.zeros((ROWS, color_dims.max() if colored else 0), np.float32),
    )
    least, cursor, waiting = min(LEAST_WEIGHT, opaque_below), (first, 0, 0), 0
    while cursor[0] < last:
        count, cursor = _next_samples(first, last, samples, cursor, lights, block)
        if count == 0:
            break
        _locate(space, count, block, points)
        encode(0, count, table, points, resolutions, offsets, hashed, mask, lanes, features)
        x, y = address(words), address(sums)
        round_rows(kind, address(features), 4 * dims[0], x, size * dims[0], ROWS, dims[0])
        through(kind, x, address(density_words), dims, y, y)
        flat = sums.reshape(-1)
        absorb(count, flat, dims[-1], bias, space[3], ZERO, block[3], block[2], points, numbers, rooms)
        _composite(count, first, closed, opaque_below, block, rooms[2], lights, numbers, weights)
        for i in range(count if colored else 0):
            if numbers[i, WEIGHT] > least:
                _color_inputs(i, block[0][i], hidden, flat, dims[-1], of_rays, hues[1], waiting)
                hues[0][waiting], hues[2][waiting, WEIGHT] = block[0][i], numbers[i, WEIGHT]
                waiting += 1
            if waiting == ROWS:
                _show_colors(kind, waiting, hues, color_words, color_dims, rooms, foreground)
                waiting = 0
    if waiting > 0:
        _show_colors(kind, waiting, hues, color_words, color_dims, rooms, foreground)


@njit
@no_type_check
def _composite_back(count, first, colored, least_slope, grads, block, numbers, suffix_sums, outer, flat, raw):
    # Gradients of a block's raw colors, contiguous in `flat`, and of its raw densities; from back to front.
    of_weights, of_light = grads
    flat[: ROWS * outer] = ZERO
    raw[count:] = ZERO
    for i in range(count - 1, -1, -1):
        r = block[0][i]
        w, g = numbers[i, WEIGHT], of_weights[r, block[1][i]]
        for c in range(3 if colored else 0):
            shade, toward = numbers[i, COLOR + c], of_light[r, c] * w
            g += of_light[r, c] * shade
            slope = shade * (ONE - shade)
            if toward * (shade - HALF) > ZERO:  # a step goes against the gradient: back from black or full
                slope = max(slope, least_slope)
            flat[i * outer + c] = toward * slope * numbers[i, SHARE]
        raw[i] = numbers[i, BACK] * (numbers[i, LIGHT] * g - suffix_sums[r - first])
        suffix_sums[r - first] += w * g


@njit
@no_type_check
def _hand_back(count, hidden, owner, passed, of_density, outer, flat, of_rays):
    # From the gradients of the color MLP's inputs to those of the density MLP's outputs, and of what rays share.
    flat[: ROWS * outer] = ZERO
    for i in range(count):
        given, to = address(passed) + 4 * i * passed.shape[1], address(flat) + 4 * i * outer
        for c in range(_copy_numbers(given, to, hidden), hidden):
            flat[i * outer + c] = passed[i, c]
        flat[i * outer] += of_density[i]
        r = owner[i]
        for c in range(of_rays.shape[1] if hidden else 0):
            of_rays[r, c] += passed[i, hidden + c]


@njit
@no_type_check
def _move_rays(count, contracted, block, toward, of_origins, of_directions):
    # From gradients of points in the unit cube to those of rays: y = x f / 4 + 1/2, with f = 2 / |x| - 1 / |x|^2.
    owner, _, t, _, x, y, z = block
    for i in range(count):
        r, gx, gy, gz = owner[i], toward[i, 0], toward[i, 1], toward[i, 2]
        if contracted:
            norm = max(np.float32(np.sqrt(x[i] * x[i] + y[i] * y[i] + z[i] * z[i])), ONE)
            factor, slope = QUARTER * (TWO - ONE / norm) / norm, ZERO
            if norm > ONE:
                slope = QUARTER * (TWO / norm - TWO) / (norm * norm * norm) * (x[i] * gx + y[i] * gy + z[i] * gz)
            gx, gy, gz = factor * gx + slope * x[i], factor * gy + slope * y[i], factor * gz + slope * z[i]
        of_origins[r, 0] += gx
        of_origins[r, 1] += gy
        of_origins[r, 2] += gz
        of_directions[r, 0] += t[i] * gx
        of_directions[r, 1] += t[i] * gy
        of_directions[r, 2] += t[i] * gz


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def _backward(kind, first, last, begin, used, space, grid, networks, numbers_of_call, grads, saved, out, totals):
    table, resolutions, offsets, hashed, mask, lanes = grid
    density_words, dims, color_words, color_dims = networks
    least_slope, hidden, wants_rays = numbers_of_call
    places, all_numbers, all_points, density_kept, color_kept = saved
    points_out, of_points, of_origins, of_directions, of_rays = out
    of_density, of_color = totals
    size, samples, colored = bytes_of(kind), space[2].shape[1] - 1, color_dims.shape[0] > 0
    widest, color_outer = max(dims.max(), color_dims.max() if colored else 0), color_dims[-1] if colored else 0
    passed = np.zeros((ROWS, color_dims[0] if colored else 0), np.float32)
    stride, color_stride = size * dims[:-1].sum(), size * color_dims[:-1].sum()
    sums, words = np.zeros((ROWS, widest), np.float32), np.zeros((3, ROWS, widest * size // 4), np.int32)
    raw, features, toward = (
        np.zeros(ROWS, np.float32),
        np.zeros((ROWS, dims[0]), np.float32),
        np.zeros((ROWS, 3), np.float32),
    )
    block, flat, next_room, outer = _new_block(), sums.reshape(-1), size * ROWS * widest, dims[-1]
    suffix_sums, width = np.zeros(last - first, np.float32), of_points.shape[1]
    for start in range((used - 1) // ROWS * ROWS, -1, -ROWS):
        count, row = min(ROWS, used - start), begin + start
        numbers, points = all_numbers[start : start + ROWS], all_points[start : start + ROWS]
        for i in range(count):
            block[0][i], block[1][i] = first + places[start + i] // samples, places[start + i] % samples
        _locate(space, count, block, points)
        _composite_back(count, first, colored, least_slope, grads, block, numbers, suffix_sums, color_outer, flat, raw)
        y, dy = address(sums), address(words)
        if colored:
            round_rows(kind, y, 4 * color_outer, dy, size * color_outer, ROWS, color_outer)
            back_through(
                kind, address(color_kept) + start * color_stride, address(color_words), color_dims, dy,
                y, dy + next_room, dy + 2 * next_room, address(of_color), True, address(passed),
            )  # fmt: skip
        _hand_back(count, hidden, block[0], passed, raw, outer, flat, of_rays)
        round_rows(kind, y, 4 * outer, dy, size * outer, ROWS, outer)
        back_through(
            kind, address(density_kept) + start * stride, address(density_words), dims, dy,
            y, dy + next_room, dy + 2 * next_room, address(of_density), True, address(features),
        )  # fmt: skip
        for i in range(count):
            for axis in range(3):
                points_out[row + i, axis] = points[i, axis]
            to = address(of_points) + 4 * (row + i) * width
            for c in range(_copy_numbers(address(features) + 4 * i * dims[0], to, width), width):
                of_points[row + i, c] = features[i, c]
        if wants_rays:
            write_point_gradient(0, count, table, points, features, resolutions, offsets, hashed, mask, lanes, toward)
            _move_rays(count, space[3], block, toward, of_origins, of_directions)

"""Density and color from the features of a hash grid, in bfloat16 for CUDA, without the arrays between the MLPs.

A block of samples goes from its features to density and color without leaving the registers. On the way back there is a
kernel for each MLP, since the gradients of all weights would not fit into the registers. They compute hidden layers
again, which is faster than reading them, but for those of a color with two, for which there are too few registers.
Products are of bfloat16 numbers, sums are float32. `TRITON_INTERPRET=1` runs the kernels without a GPU.
"""

import functools
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import BFloat16, Float, Int
from torch import Tensor
from triton.runtime.errors import OutOfResources

from nerf_lightning.nerf.activations import LARGEST_RAW, LARGEST_SLOPE_RAW
from nerf_lightning.nerf.kernels.hash_grid.cuda import BLOCK as GRID_BLOCK
from nerf_lightning.nerf.kernels.mlp.cuda import (
    BACKWARD,
    BACKWARD_BLOCK,
    BLOCK,
    FORWARD,
    INTERPRETED,
    activated,
    layer_weights,
    multiply,
    padded,
    passed_back,
    rows_of,
    saved_at,
    store_sum,
    sums_of_programs,
    total,
)
from nerf_lightning.nerf.kernels.padding import end_of_rows

PADDING = tl.constexpr(GRID_BLOCK)
WIDEST = 64


class Samples(NamedTuple):
    """Arrays that place samples on rays; `each` samples per ray, or as the index says."""

    ray_index: Int[Tensor, "samples"]
    starts: Float[Tensor, "edges"]
    ends: Float[Tensor, "edges"]
    points: Float[Tensor, "samples 3"]
    """In the unit cube."""
    each: int
    used: Int[Tensor, "1"] | None
    """The index from which all samples are padding, on the device; None: there is no padding."""

    @property
    def size(self) -> int:
        """The number of samples, padding included."""
        return self.points.shape[0]


class Activations(NamedTuple):
    """What turns raw outputs into density and color (`nerf.activations`)."""

    bias: float
    """Added to the raw density before the exponential."""
    least_slope: float
    """Minimum slope of a color over its raw value on the way back from black or full."""
    whole_from: float
    """Gradients of samples nearer than this are scaled down (`rendering.near_gradients`); 0: of none."""
    boxed: bool
    """Whether there is no density outside the unit cube."""


@functools.cache
def takes(density_widths: tuple[int, ...], color_widths: tuple[int, ...], device: torch.device) -> bool:
    """Return whether the kernels run here for MLPs of these widths, from inputs to outputs; tried once.

    Elsewhere the kernels of the single MLPs do.
    """
    if len(density_widths) != 3 or len(color_widths) not in (0, 3, 4) or max(*density_widths, *color_widths) > WIDEST:
        return False
    shared = color_widths[0] - density_widths[-1] if color_widths else 0
    if shared < 0:
        return False
    density_weights, color_weights = (
        [torch.zeros(outer, inner, device=device) for inner, outer in pairwise(widths)]
        for widths in (density_widths, color_widths)
    )
    features = torch.zeros(BLOCK, density_widths[0], dtype=torch.bfloat16, device=device)
    zeros = torch.zeros(BLOCK, device=device)
    where = Samples(zeros.long(), zeros, zeros, torch.zeros(BLOCK, 3, device=device), 0, None)
    how, of_ray = Activations(0.0, 0.0, 0.0, boxed=True), torch.zeros(1, shared, device=device)
    weights = of_ray, where, density_weights, color_weights, how
    try:
        density, rgb, saved = forward(features, *weights, keep=True)
        backward(density, rgb, saved, features, *weights)
    except OutOfResources:
        return False
    return True


def forward(
    features: BFloat16[Tensor, "samples features"],
    shared: Float[Tensor, "rays shared"],
    where: Samples,
    density_weights: Sequence[Tensor],
    color_weights: Sequence[Tensor],
    how: Activations,
    keep: bool,
) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples 3"], tuple[Tensor, Tensor]]:
    """Return density, color, and what `backward` reads if it is kept; zeros from sample `used` on.

    Rounded up to a block: a program whose samples are all padding computes nothing.

    Args:
        features: of the hash grid.
        shared: what the samples of a ray share: inputs of the color after the density MLP's outputs.
        where: the samples.
        density_weights: of two layers.
        color_weights: of two or three; none: black.
        how: activations.
        keep: whether there will be a backward pass.
    """
    count = features.shape[0]
    density = torch.empty(count, device=features.device)
    rgb = density.new_empty(count, 3)
    rows, deep = count if keep and color_weights else 0, len(color_weights) == 3
    # The density MLP's outputs, and both hidden layers of a color that has two.
    hidden = density.new_empty(rows, density_weights[-1].shape[0], dtype=torch.bfloat16)
    layers = hidden.new_empty(rows if deep else 0, sum(padded(each.shape[0]) for each in color_weights[:-1]))
    if count:
        arrays = features, shared.contiguous(), where.ray_index, where.points, *_five(density_weights, color_weights)
        flags = how.boxed, bool(rows), bool(color_weights), deep, where.each, BLOCK, INTERPRETED
        _forward[(triton.cdiv(count, BLOCK),)](
            *arrays, density, rgb, hidden, layers, how.bias, LARGEST_RAW, where.used, count,
            *_sizes(density_weights, color_weights, shared), *flags, **FORWARD,
        )  # fmt: skip
    return density, rgb, (hidden, layers)


def backward(
    of_density: Float[Tensor, "samples"],
    of_rgb: Float[Tensor, "samples 3"],
    saved: tuple[Tensor, Tensor],
    features: BFloat16[Tensor, "samples features"],
    shared: Float[Tensor, "rays shared"],
    where: Samples,
    density_weights: Sequence[Tensor],
    color_weights: Sequence[Tensor],
    how: Activations,
) -> tuple[BFloat16[Tensor, "samples features"], list[Tensor]]:
    """Return the gradients of the features, and of all weights.

    `saved` is what `forward` returned for the other arguments.
    """
    count, sizes = features.shape[0], _sizes(density_weights, color_weights, shared)
    hidden, layers = saved
    of_features, of_hidden = torch.empty_like(features), torch.empty_like(hidden)
    numbers = how.whole_from, where.used, count, *sizes, how.whole_from > 0
    options = where.each, BACKWARD_BLOCK, INTERPRETED
    of_color: list[Tensor] = []
    if color_weights:
        rows, own = color_weights[0].shape[0], hidden.shape[1]
        shapes = [(rows, own), (rows, shared.shape[1]), *(tuple(weight.shape) for weight in color_weights[1:])]
        sums, weights = sums_of_programs(shapes, count, features.device), _five(density_weights, color_weights)[2:]
        arrays = hidden, layers, shared.contiguous(), *where[:3], *weights, of_hidden, sums, how.least_slope, *numbers
        _backward_color[(len(sums),)](of_rgb.contiguous(), *arrays, len(color_weights) == 3, *options, **BACKWARD)
        of_own, of_shared, *of_others = total(sums, shapes)
        of_color = [torch.cat([of_own, of_shared], dim=1), *of_others]
    shapes = [tuple(weight.shape) for weight in density_weights]
    sums = sums_of_programs(shapes, count, features.device)
    arrays = of_hidden, features, *where[:4], *_five(density_weights, color_weights)[:2], of_features, sums
    flags = bool(color_weights), how.boxed
    _backward_density[(len(sums),)](
        of_density.contiguous(), *arrays, how.bias, LARGEST_SLOPE_RAW, *numbers, *flags, *options, **BACKWARD
    )
    return of_features, [*total(sums, shapes), *of_color]


def trial(device: str = "cuda") -> None:
    """Run every kernel once on tiny input; it raises whatever the compiler or driver raises.

    Raises:
        RuntimeError: a product is wrong; all sums here are exact.
    """
    features, zeros = torch.ones(4, 16, dtype=torch.bfloat16, device=device), torch.zeros(4, device=device)
    where = Samples(zeros.long(), zeros, zeros, torch.zeros(4, 3, device=device), 0, None)
    density_weights = [torch.full((16, 16), 0.0625, device=device)] * 2
    first, last = torch.full((16, 32), 0.03125, device=device), torch.full((3, 16), 0.0625, device=device)
    shared, how = torch.ones(1, 16, device=device), Activations(-1.0, 0.0, 0.0, True)
    for color_weights in ([first, last], [first, density_weights[0], last]):
        given = features, shared, where, density_weights, color_weights, how
        density, rgb, saved = forward(*given, keep=True)
        of_features, of_weights = backward(zeros + 1.0, 0.0 * rgb, saved, *given)
        if density.tolist() != [1.0] * 4 or abs(float(rgb[0, 0]) - 0.7310586) > 1e-5:
            raise RuntimeError("a trial of its kernels gave wrong numbers")
        if float(of_features[0, 0]) != 0.0625 or of_weights[1][0].tolist() != [4.0] * 16 or of_weights[1][1].any():
            raise RuntimeError("a trial of its kernels gave wrong gradients")


def _five(density_weights: Sequence[Tensor], color_weights: Sequence[Tensor]) -> list[Tensor]:
    """Return five weights, as the kernels expect: the color's first, second and last; they ignore what is not there."""
    color = color_weights or density_weights
    return [each.contiguous() for each in (*density_weights, color[0], color[1], color[-1])]


def _sizes(density_weights: Sequence[Tensor], color_weights: Sequence[Tensor], shared: Tensor) -> tuple[int, ...]:
    """Return the widths of features, density's layers, what is shared, color's first and last hidden; padded, too."""
    layers = density_weights[0].T, *density_weights, shared.T, *color_weights[:1], *color_weights[-2:-1]
    widths = [each.shape[0] for each in layers]
    widths += [1] * (6 - len(widths))
    return *widths, *map(padded, widths)


@triton.jit
@no_type_check
def midpoint(ray_index, starts, ends, sample, valid, each: tl.constexpr):
    """Return the rays and midpoints of some samples."""
    if each > 0:
        ray = sample // each
        shift = ray
    else:
        ray = tl.load(ray_index + sample, mask=valid, other=0)
        shift = ray * 0
    begin = tl.load(starts + sample + shift, mask=valid, other=0.0)
    return ray, 0.5 * (begin + tl.load(ends + sample + shift, mask=valid, other=0.0))


@triton.jit
@no_type_check
def inside(points, sample, valid):
    """Return whether points are in the unit cube."""
    x = tl.load(points + 3 * sample, mask=valid, other=0.0)
    y = tl.load(points + 3 * sample + 1, mask=valid, other=0.0)
    z = tl.load(points + 3 * sample + 2, mask=valid, other=0.0)
    nearest = tl.minimum(tl.minimum(x, y), z)
    return (nearest >= 0.0) & (tl.maximum(tl.maximum(x, y), z) <= 1.0)


@triton.jit
@no_type_check
def color_slope(color, grad, least_slope):
    """Return the slope of a color over its raw value; a step goes against the gradient: back from black or full."""
    slope = color * (1.0 - color)
    return tl.where(grad * (color - 0.5) > 0.0, tl.maximum(slope, least_slope), slope)


@triton.jit
@no_type_check
def _first_color_weights(weight, first, n_in: tl.constexpr, total: tl.constexpr, n_out: tl.constexpr,
                         inner: tl.constexpr, outer: tl.constexpr):  # fmt: skip
    """Return some columns of the color's first layer in bfloat16, with zeros around them."""
    row, column = tl.arange(0, outer)[:, None], tl.arange(0, inner)[None, :]
    there = (row < n_out) & (column < n_in)
    return tl.load(weight + row * total + first + column, mask=there, other=0.0).to(tl.bfloat16)


@triton.jit
@no_type_check
def _outputs_of_density(
    features, w0, w1, row, count, n0: tl.constexpr, n1: tl.constexpr, n2: tl.constexpr, d0: tl.constexpr,
    d1: tl.constexpr, d2: tl.constexpr, widen: tl.constexpr,
):  # fmt: skip
    """Return inputs, hidden layer and outputs of the density MLP."""
    x = rows_of(features, row, count, n0, d0)
    y = activated(x, w0, n0, n1, d0, d1, widen)
    return x, y, multiply(y, tl.trans(layer_weights(w1, n1, n2, d1, d2)), widen)


@triton.jit
@no_type_check
def _first_of_color(
    h, s, c0, n2: tl.constexpr, ns: tl.constexpr, n3: tl.constexpr, d2: tl.constexpr, ds: tl.constexpr,
    d3: tl.constexpr, widen: tl.constexpr,
):  # fmt: skip
    """Return the first hidden layer of the color MLP."""
    sums = multiply(h, tl.trans(_first_color_weights(c0, 0, n2, n2 + ns, n3, d2, d3)), widen)
    sums += multiply(s, tl.trans(_first_color_weights(c0, n2, ns, n2 + ns, n3, ds, d3)), widen)
    return tl.maximum(sums, 0.0, propagate_nan=tl.PropagateNan.ALL).to(tl.bfloat16)


@triton.jit
@no_type_check
def _color(hidden, last, n_in: tl.constexpr, inner: tl.constexpr, widen: tl.constexpr):
    """Return the colors from the last hidden layer, padded to 16."""
    return tl.sigmoid(multiply(hidden, tl.trans(layer_weights(last, n_in, 3, inner, 16)), widen))


@triton.jit
@no_type_check
def _shared_by_rays(shared, ray_index, sample, valid, ns: tl.constexpr, ds: tl.constexpr, each: tl.constexpr):
    """Return what the samples' rays give to them, in bfloat16."""
    ray = sample // each if each > 0 else tl.load(ray_index + sample, mask=valid, other=0)
    column = tl.arange(0, ds)[None, :]
    there = valid[:, None] & (column < ns)
    return tl.load(shared + ray[:, None] * ns + column, mask=there, other=0.0).to(tl.bfloat16)


@triton.jit
@no_type_check
def _share(ray_index, starts, ends, sample, valid, whole_from, softened: tl.constexpr, each: tl.constexpr):
    """Return by how much gradients of samples are scaled down."""
    share = sample.to(tl.float32) * 0.0 + 1.0
    if softened:
        _, t = midpoint(ray_index, starts, ends, sample, valid, each)
        share = tl.minimum((t / whole_from) * (t / whole_from), 1.0)
    return share


@triton.jit
@no_type_check
def _last(used, count):
    """Return the end of the samples whose gradients are read.

    The kernels of the hash grid read to the end of their last block, whose padding has none.
    """
    return tl.minimum((end_of_rows(used, count) + PADDING - 1) // PADDING * PADDING, count)


@triton.jit
@no_type_check
def _forward(
    features, shared, ray_index, points, w0, w1, c0, c1, c2, density, rgb, hidden, layers, bias, largest, used, count,
    n0: tl.constexpr, n1: tl.constexpr, n2: tl.constexpr, ns: tl.constexpr, n3: tl.constexpr, n4: tl.constexpr,
    d0: tl.constexpr, d1: tl.constexpr, d2: tl.constexpr, ds: tl.constexpr, d3: tl.constexpr, d4: tl.constexpr,
    boxed: tl.constexpr, keep: tl.constexpr, colored: tl.constexpr, deep: tl.constexpr, each: tl.constexpr,
    block: tl.constexpr, widen: tl.constexpr,
):  # fmt: skip
    sample = (tl.program_id(0) * block + tl.arange(0, block)).to(tl.int64)
    valid, channel, column = sample < count, tl.arange(0, 16)[None, :], tl.arange(0, d2)[None, :]
    at, there = rgb + 3 * sample[:, None] + channel, valid[:, None] & (channel < 3)
    if tl.program_id(0) * block >= end_of_rows(used, count):
        tl.store(density + sample, tl.zeros([block], tl.float32), mask=valid)
        tl.store(at, tl.zeros([block, 16], tl.float32), mask=there)
        return
    _, _, out = _outputs_of_density(features, w0, w1, sample, count, n0, n1, n2, d0, d1, d2, widen)
    sigma = tl.sum(tl.where(column == 0, out, 0.0), axis=1) + bias
    sigma = tl.exp(tl.minimum(sigma, largest, propagate_nan=tl.PropagateNan.ALL))
    if boxed:
        sigma = tl.where(inside(points, sample, valid), sigma, 0.0)
    tl.store(density + sample, sigma, mask=valid)
    color = tl.zeros([block, 16], tl.float32)
    if colored:
        h, s = out.to(tl.bfloat16), _shared_by_rays(shared, ray_index, sample, valid, ns, ds, each)
        if keep:
            tl.store(hidden + sample[:, None] * n2 + column, h, mask=valid[:, None] & (column < n2))
        y = _first_of_color(h, s, c0, n2, ns, n3, d2, ds, d3, widen)
        if deep:
            if keep:
                tl.store(saved_at(layers, sample, d3 + d4, 0, d3), y, mask=valid[:, None])
            y = activated(y, c1, n3, n4, d3, d4, widen)
            if keep:
                tl.store(saved_at(layers, sample, d3 + d4, d3, d4), y, mask=valid[:, None])
        color = _color(y, c2, n4, d4, widen)
    tl.store(at, color, mask=there)


@triton.jit
@no_type_check
def _backward_color(
    of_rgb, hidden, layers, shared, ray_index, starts, ends, c0, c1, c2, of_hidden, sums, least_slope, whole_from,
    used, count,
    n0: tl.constexpr, n1: tl.constexpr, n2: tl.constexpr, ns: tl.constexpr, n3: tl.constexpr, n4: tl.constexpr,
    d0: tl.constexpr, d1: tl.constexpr, d2: tl.constexpr, ds: tl.constexpr, d3: tl.constexpr, d4: tl.constexpr,
    softened: tl.constexpr, deep: tl.constexpr, each: tl.constexpr, block: tl.constexpr, widen: tl.constexpr,
):  # fmt: skip
    of_own, of_shared = tl.zeros([d3, d2], tl.float32), tl.zeros([d3, ds], tl.float32)
    of_last = tl.zeros([16, d4], tl.float32)
    if deep:
        of_second = tl.zeros([d4, d3], tl.float32)
    channel, column, last = tl.arange(0, 16)[None, :], tl.arange(0, d2)[None, :], _last(used, count)
    for start in range(tl.program_id(0) * block, last, tl.num_programs(0) * block):
        sample = (start + tl.arange(0, block)).to(tl.int64)
        valid = sample < count
        h, s = rows_of(hidden, sample, count, n2, d2), _shared_by_rays(shared, ray_index, sample, valid, ns, ds, each)
        if deep:
            z = tl.load(saved_at(layers, sample, d3 + d4, d3, d4), mask=valid[:, None], other=0.0)
        else:
            z = _first_of_color(h, s, c0, n2, ns, n3, d2, ds, d3, widen)
        color = _color(z, c2, n4, d4, widen)
        share = _share(ray_index, starts, ends, sample, valid, whole_from, softened, each)
        there = valid[:, None] & (channel < 3)
        of_color = tl.load(of_rgb + 3 * sample[:, None] + channel, mask=there, other=0.0) * share[:, None]
        flowing = (of_color * color_slope(color, of_color, least_slope)).to(tl.bfloat16)
        of_last += multiply(tl.trans(flowing), z, widen)
        flowing = passed_back(flowing, z, c2, n4, 3, d4, 16, widen)
        if deep:
            y = tl.load(saved_at(layers, sample, d3 + d4, 0, d3), mask=valid[:, None], other=0.0)
            of_second += multiply(tl.trans(flowing), y, widen)
            flowing = passed_back(flowing, y, c1, n3, n4, d3, d4, widen)
        of_own += multiply(tl.trans(flowing), h, widen)
        of_shared += multiply(tl.trans(flowing), s, widen)
        of_h = multiply(flowing, _first_color_weights(c0, 0, n2, n2 + ns, n3, d2, d3), widen)
        at = of_hidden + sample[:, None] * n2 + column
        tl.store(at, of_h.to(tl.bfloat16), mask=valid[:, None] & (column < n2))
    of_first: tl.constexpr = (d2 + ds) * d3
    of_others: tl.constexpr = of_first + (d3 * d4 if deep else 0)
    own = sums + tl.program_id(0) * (of_others + d4 * 16)
    store_sum(own, 0, of_own, d2, d3)
    store_sum(own, d2 * d3, of_shared, ds, d3)
    if deep:
        store_sum(own, of_first, of_second, d3, d4)
    store_sum(own, of_others, of_last, d4, 16)


@triton.jit
@no_type_check
def _backward_density(
    of_density, of_hidden, features, ray_index, starts, ends, points, w0, w1, of_features, sums, bias, largest,
    whole_from, used, count,
    n0: tl.constexpr, n1: tl.constexpr, n2: tl.constexpr, ns: tl.constexpr, n3: tl.constexpr, n4: tl.constexpr,
    d0: tl.constexpr, d1: tl.constexpr, d2: tl.constexpr, ds: tl.constexpr, d3: tl.constexpr, d4: tl.constexpr,
    softened: tl.constexpr, colored: tl.constexpr, boxed: tl.constexpr, each: tl.constexpr, block: tl.constexpr,
    widen: tl.constexpr,
):  # fmt: skip
    of_w0, of_w1 = tl.zeros([d1, d0], tl.float32), tl.zeros([d2, d1], tl.float32)
    column, output, last = tl.arange(0, d0)[None, :], tl.arange(0, d2)[None, :], _last(used, count)
    for start in range(tl.program_id(0) * block, last, tl.num_programs(0) * block):
        sample = (start + tl.arange(0, block)).to(tl.int64)
        valid = sample < count
        x, y, out = _outputs_of_density(features, w0, w1, sample, count, n0, n1, n2, d0, d1, d2, widen)
        sigma = tl.sum(tl.where(output == 0, out, 0.0), axis=1) + bias
        slope = tl.exp(tl.minimum(tl.maximum(sigma, -largest), largest))
        slope *= _share(ray_index, starts, ends, sample, valid, whole_from, softened, each)
        grad = tl.load(of_density + sample, mask=valid, other=0.0) * slope
        if boxed:
            grad = tl.where(inside(points, sample, valid), grad, 0.0)
        flowing = tl.where(output == 0, grad[:, None], 0.0)
        if colored:
            flowing += rows_of(of_hidden, sample, count, n2, d2).to(tl.float32)
        flowing = flowing.to(tl.bfloat16)
        of_w1 += multiply(tl.trans(flowing), y, widen)
        flowing = passed_back(flowing, y, w1, n1, n2, d1, d2, widen)
        of_w0 += multiply(tl.trans(flowing), x, widen)
        of_x = multiply(flowing, layer_weights(w0, n0, n1, d0, d1), widen)
        at = of_features + sample[:, None] * n0 + column
        tl.store(at, of_x.to(tl.bfloat16), mask=valid[:, None] & (column < n0))
    for start in range(last + tl.program_id(0) * block, count, tl.num_programs(0) * block):  # the rest of the padding
        sample = (start + tl.arange(0, block)).to(tl.int64)[:, None]
        nothing = tl.zeros([block, d0], tl.bfloat16)
        tl.store(of_features + sample * n0 + column, nothing, mask=(sample < count) & (column < n0))
    own = sums + tl.program_id(0) * (d0 * d1 + d1 * d2)
    store_sum(own, 0, of_w0, d0, d1)
    store_sum(own, d0 * d1, of_w1, d1, d2)

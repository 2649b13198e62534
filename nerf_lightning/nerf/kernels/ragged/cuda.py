"""Volume rendering for CUDA: a program sums along one ray, 32 samples at a time.

If all rays have the same number of samples, `starts` and `ends` are views of their fenceposts, and there are no bounds.
Letters as in `kernels.ragged.op`. Sums along a ray have a fixed order, so results are deterministic.
`TRITON_INTERPRET=1` runs the kernels without a GPU.
"""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from nerf_lightning.nerf.types.rays import RaggedSamples

BLOCK = 32


def integrate(
    density: Float[Tensor, "n"],
    rgb: Float[Tensor, "n 3"],
    starts: Float[Tensor, "starts"],
    ends: Float[Tensor, "ends"],
    bounds: Shaped[Tensor, "bounds"],
    each: int = 0,
    closed: bool = False,
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"], Float[Tensor, "rays"], Float[Tensor, "n"]]:
    """Return, per ray, sum of w rgb, sum of w, sum of w t, and the weights w.

    Args:
        density: per unit length.
        rgb: in [0, 1].
        starts: where each interval begins; for rays with the same number of samples, all fenceposts.
        ends: where it ends; for such rays, the fenceposts from the second on.
        bounds: the samples of ray r are those from bounds[r] to bounds[r + 1].
        each: samples per ray, if there are no bounds; 0: as the bounds say.
        closed: whether the last sample of a ray absorbs all remaining light.
    """
    capacity = density.shape[0]
    rays = capacity // each if each else bounds.shape[0] - 1
    foreground, weights = density.new_empty(rays, 3), torch.empty_like(density)
    opacity, depth = density.new_empty(rays), density.new_empty(rays)
    if rays:
        arrays = density, rgb, starts, ends, bounds, foreground, opacity, depth, weights
        _integrate[(rays,)](*arrays, capacity, rays, each, closed, BLOCK, num_warps=1)
    return foreground, opacity, depth, weights


def integrate_gradient(
    density: Float[Tensor, "n"],
    rgb: Float[Tensor, "n 3"],
    starts: Float[Tensor, "starts"],
    ends: Float[Tensor, "ends"],
    bounds: Shaped[Tensor, "bounds"],
    weights: Float[Tensor, "n"],
    of_foreground: Float[Tensor, "rays 3"],
    of_opacity: Float[Tensor, "rays"],
    of_depth: Float[Tensor, "rays"],
    of_weights: Float[Tensor, "n"],
    each: int = 0,
    closed: bool = False,
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"]]:
    """Return the gradients of density and color, given those of the four outputs."""
    of_density, of_rgb = torch.empty_like(density), torch.empty_like(rgb)
    capacity = density.shape[0]
    rays = capacity // each if each else bounds.shape[0] - 1
    if rays:
        arrays = density, rgb, starts, ends, bounds, weights, of_foreground, of_opacity, of_depth, of_weights
        _integrate_back[(rays,)](*arrays, of_density, of_rgb, capacity, rays, each, closed, BLOCK, num_warps=1)
    return of_density, of_rgb


def num_visible(density: Float[Tensor, "n"], samples: RaggedSamples, opaque_below: float) -> Int[Tensor, "rays"]:
    """Return how many samples of each ray begin where the transmittance exceeds `opaque_below`."""
    counts = torch.empty_like(samples.bounds[1:])
    if counts.numel():
        arrays = density.contiguous(), samples.starts, samples.ends, samples.bounds, counts
        _num_visible[(counts.numel(),)](*arrays, opaque_below, BLOCK, num_warps=1)
    return counts


def first_of_each_ray(
    samples: RaggedSamples,
    counts: Int[Tensor, "rays"],
    features: Float[Tensor, "n features"] | None,
    capacity: int,
) -> tuple[RaggedSamples, Float[Tensor, "capacity features"] | None]:
    """Return the first `counts` samples of each ray, and their features."""
    rays, width = counts.shape[0], 0 if features is None else features.shape[1]
    index, bounds = counts.new_empty(capacity), torch.empty_like(samples.bounds)
    starts, ends = samples.starts.new_empty(capacity), samples.ends.new_empty(capacity)
    left = (starts if features is None else features).new_empty(capacity, width)
    found = torch.empty_like(samples.found)
    given = samples.starts, samples.ends, samples.bounds, samples.found, counts.cumsum(0)
    arrays = *given, starts if features is None else features.contiguous(), index, starts, ends, bounds, found, left
    sizes = rays, capacity, width, triton.next_power_of_2(max(1, width))
    _first[(max(1, rays),)](*arrays, *sizes, BLOCK, num_warps=1)
    kept = RaggedSamples(index, starts, ends, bounds, found, samples.longest)
    return kept, None if features is None else left


def trial(device: str = "cuda") -> None:
    """Run every kernel once on tiny input; it raises whatever the compiler or driver raises."""
    one, bounds = torch.ones(2, device=device), torch.tensor([0, 1, 2], device=device)
    given = one, torch.ones(2, 3, device=device), 0 * one, one, bounds
    foreground, opacity, depth, weights = integrate(*given)
    integrate_gradient(*given, weights, foreground, opacity, depth, weights)
    samples = RaggedSamples(bounds[:2], 0 * one, one, bounds, bounds[-1])
    first_of_each_ray(samples, num_visible(one, samples, 0.5), one[:, None], 2)
    if abs(float(opacity[1]) - 0.6321206) > 1e-5:
        raise RuntimeError("a trial of its kernels gave wrong numbers")


@triton.jit
@no_type_check
def _alpha(optical):
    """Return 1 - exp(-x), by its series where it would lose all digits."""
    series = optical * (1.0 - optical * (0.5 - optical * (1.0 / 6.0 - optical * (1.0 / 24.0))))
    return tl.where(optical < 0.03, series, 1.0 - tl.exp(-optical))


@triton.jit
@no_type_check
def _samples_of(bounds, ray, each):
    """Return the first sample of a ray, the one after its last, and the offset of its intervals' indices."""
    if each > 0:
        first = ray.to(tl.int64) * each
        last = first + each
        shift = ray
    else:
        first = tl.load(bounds + ray)
        last = tl.load(bounds + ray + 1)
        shift = ray * 0
    return first, last, shift


@triton.jit
@no_type_check
def _optical(density, starts, ends, sample, valid):
    """Return density times length of some samples, and their midpoints."""
    begin, end = tl.load(starts + sample, mask=valid, other=0.0), tl.load(ends + sample, mask=valid, other=0.0)
    return tl.load(density + sample, mask=valid, other=0.0) * (end - begin), 0.5 * (begin + end)


@triton.jit
@no_type_check
def _light(before, density, starts, ends, sample, first, valid):
    """Return the light that reaches some consecutive samples, given the optical depth before them.

    The sum excludes each sample itself: subtracting it would lose what is in front of a dense one.
    """
    nearer, _ = _optical(density, starts, ends, sample - 1, valid & (sample > first))
    return tl.exp(-(before + tl.cumsum(nearer, axis=0)))


@triton.jit
@no_type_check
def _integrate(
    density, rgb, starts, ends, bounds, foreground, opacity, depth, weights, capacity, rays, each: tl.constexpr,
    closed: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    ray, lane = tl.program_id(0), tl.arange(0, block)
    first, last, shift = _samples_of(bounds, ray, each)
    starts, ends = starts + shift, ends + shift
    before, reds, greens, blues, total, far = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for start in range(first, last, block):
        sample = start + lane
        valid = sample < last
        optical, t = _optical(density, starts, ends, sample, valid)
        alpha = _alpha(optical)
        if closed:
            alpha = tl.where(sample == last - 1, 1.0, alpha)
        w = _light(before, density, starts, ends, sample, start, valid) * alpha
        before += tl.sum(optical, axis=0)
        tl.store(weights + sample, w, mask=valid)
        reds += tl.sum(w * tl.load(rgb + 3 * sample, mask=valid, other=0.0), axis=0)
        greens += tl.sum(w * tl.load(rgb + 3 * sample + 1, mask=valid, other=0.0), axis=0)
        blues += tl.sum(w * tl.load(rgb + 3 * sample + 2, mask=valid, other=0.0), axis=0)
        total += tl.sum(w, axis=0)
        far += tl.sum(w * t, axis=0)
    tl.store(foreground + 3 * ray, reds)
    tl.store(foreground + 3 * ray + 1, greens)
    tl.store(foreground + 3 * ray + 2, blues)
    tl.store(opacity + ray, total)
    tl.store(depth + ray, far)
    used = capacity if each > 0 else tl.load(bounds + rays)
    for start in range(used + ray * block, capacity, rays * block):  # padding
        tl.store(weights + start + lane, tl.zeros([block], tl.float32), mask=start + lane < capacity)


@triton.jit
@no_type_check
def _integrate_back(
    density, rgb, starts, ends, bounds, weights, of_foreground, of_opacity, of_depth, of_weights, of_density, of_rgb,
    capacity, rays, each: tl.constexpr, closed: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    ray, lane = tl.program_id(0), tl.arange(0, block)
    first, last, shift = _samples_of(bounds, ray, each)
    starts, ends = starts + shift, ends + shift
    of_red, of_green = tl.load(of_foreground + 3 * ray), tl.load(of_foreground + 3 * ray + 1)
    of_blue = tl.load(of_foreground + 3 * ray + 2)
    toward_opacity, toward_depth = tl.load(of_opacity + ray), tl.load(of_depth + ray)
    before = 0.0
    for start in range(first, last, block):
        sample = start + lane
        optical, _ = _optical(density, starts, ends, sample, sample < last)
        # Kept for the reverse loop: the light behind each sample.
        tl.store(of_density + sample, tl.exp(-(before + tl.cumsum(optical, axis=0))), mask=sample < last)
        before += tl.sum(optical, axis=0)
    tl.debug_barrier()
    behind = 0.0
    for chunk in range((last - first + block - 1) // block):
        sample = first + ((last - first + block - 1) // block - 1 - chunk) * block + lane
        valid = sample < last
        begin, end = tl.load(starts + sample, mask=valid, other=0.0), tl.load(ends + sample, mask=valid, other=0.0)
        light_after = tl.load(of_density + sample, mask=valid, other=0.0)
        if closed:
            light_after = tl.where(sample == last - 1, 0.0, light_after)
        w = tl.load(weights + sample, mask=valid, other=0.0)
        red = tl.load(rgb + 3 * sample, mask=valid, other=0.0)
        green = tl.load(rgb + 3 * sample + 1, mask=valid, other=0.0)
        blue = tl.load(rgb + 3 * sample + 2, mask=valid, other=0.0)
        g = of_red * red + of_green * green + of_blue * blue + toward_opacity + toward_depth * 0.5 * (begin + end)
        g += tl.load(of_weights + sample, mask=valid, other=0.0)
        wg = w * g
        later = behind + tl.cumsum(wg, axis=0, reverse=True) - wg
        behind += tl.sum(wg, axis=0)
        tl.store(of_density + sample, (end - begin) * (light_after * g - later), mask=valid)
        tl.store(of_rgb + 3 * sample, w * of_red, mask=valid)
        tl.store(of_rgb + 3 * sample + 1, w * of_green, mask=valid)
        tl.store(of_rgb + 3 * sample + 2, w * of_blue, mask=valid)
    nothing = tl.zeros([block], tl.float32)
    used = capacity if each > 0 else tl.load(bounds + rays)
    for start in range(used + ray * block, capacity, rays * block):  # padding
        sample = start + lane
        tl.store(of_density + sample, nothing, mask=sample < capacity)
        for channel in tl.static_range(3):
            tl.store(of_rgb + 3 * sample + channel, nothing, mask=sample < capacity)


@triton.jit
@no_type_check
def _num_visible(density, starts, ends, bounds, counts, opaque_below, block: tl.constexpr):
    ray, lane = tl.program_id(0), tl.arange(0, block)
    first, last = tl.load(bounds + ray), tl.load(bounds + ray + 1)
    before, seen = 0.0, tl.zeros([], tl.int64)
    for start in range(first, last, block):
        valid = start + lane < last
        light = _light(before, density, starts, ends, start + lane, start, valid)
        optical, _ = _optical(density, starts, ends, start + lane, valid)
        before += tl.sum(optical, axis=0)
        seen += tl.sum((valid & (light > opaque_below)).to(tl.int64), axis=0)
    tl.store(counts + ray, seen)


@triton.jit
@no_type_check
def _first(
    starts, ends, bounds, num_found, ends_of_rays, features, to_index, to_starts, to_ends, to_bounds, to_found,
    to_features, rays, capacity, width: tl.constexpr, columns: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    ray, lane, column = tl.program_id(0).to(tl.int64), tl.arange(0, block), tl.arange(0, columns)[None, :]
    total = tl.load(ends_of_rays + rays - 1, mask=rays > 0, other=0)
    used = tl.minimum(total, capacity)
    if ray == 0:
        tl.store(to_bounds + rays, used)
        tl.store(to_found, total + tl.load(num_found) - tl.load(bounds + rays))
    if ray < rays:
        begin = tl.load(ends_of_rays + ray - 1, mask=ray > 0, other=0)
        first, last = tl.minimum(begin, capacity), tl.minimum(tl.load(ends_of_rays + ray), capacity)
        tl.store(to_bounds + ray, first)
        shift = tl.load(bounds + ray) - begin
        for start in range(first, last, block):
            slot = start + lane
            inside = slot < last
            tl.store(to_index + slot, ray + 0 * slot, mask=inside)
            tl.store(to_starts + slot, tl.load(starts + slot + shift, mask=inside, other=0.0), mask=inside)
            tl.store(to_ends + slot, tl.load(ends + slot + shift, mask=inside, other=0.0), mask=inside)
            if width > 0:
                row, there = slot[:, None], inside[:, None] & (column < width)
                values = tl.load(features + (row + shift) * width + column, mask=there, other=0.0)
                tl.store(to_features + row * width + column, values, mask=there)
        # Padding of no length, spread over the rays.
        for start in range(used + ray * block, capacity, rays * block):
            slot = start + lane
            inside = slot < capacity
            tl.store(to_index + slot, slot % rays, mask=inside)
            tl.store(to_starts + slot, tl.zeros([block], tl.float32), mask=inside)
            tl.store(to_ends + slot, tl.zeros([block], tl.float32), mask=inside)
            if width > 0:
                there = inside[:, None] & (column < width)
                nothing = tl.zeros([block, columns], tl.float32)
                tl.store(to_features + slot[:, None] * width + column, nothing, mask=there)

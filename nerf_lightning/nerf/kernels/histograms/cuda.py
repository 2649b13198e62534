"""Histograms along rays for CUDA: a program processes a ray, and compares all of its bins at once.

Letters as in `rendering.histograms` and `losses.proposal`. Results are deterministic.
`TRITON_INTERPRET=1` runs the kernels without a GPU.
"""

from collections.abc import Callable
from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.contraction import TINY
from nerf_lightning.nerf.kernels.histograms.op import (
    HISTOGRAM_PADDING,
    RayLoss,
    distortion,
    interlevel,
    takes_bounds,
    takes_histogram,
)
from nerf_lightning.nerf.types.renderings import DenseRendering

LANES = 32
"""Number of samples searched in all bins at a time."""
BINS_OF_A_WARP = 64


def sample_histogram(
    edges: Float[Tensor, "*rays edges"],
    weights: Float[Tensor, "*rays bins"],
    u: Float[Tensor, "*rays count"],
    padding: float = HISTOGRAM_PADDING,
    contracted: bool = False,
) -> Float[Tensor, "*rays count"] | None:
    """Return where the cumulative distribution of a histogram reaches `u`, which increases along each row."""
    if not takes_histogram(edges, weights, u):
        return None
    out = torch.empty(u.shape, device=u.device)
    if out.numel():
        arrays = edges.contiguous(), weights.contiguous(), u.contiguous(), out
        bins, count = weights.shape[1], u.shape[1]
        block = triton.next_power_of_2(bins)
        sizes = bins, count, contracted, block, LANES
        _sample[(len(u),)](*arrays, padding, TINY, *sizes, num_warps=_warps(block))
    return out


def stratified_edges(
    shares: Float[Tensor, "edges"],
    jitter: Float[Tensor, "*rays inner"] | None,
    low: Float[Tensor, "*rays"],
    high: Float[Tensor, "*rays"],
    contracted: bool,
) -> Float[Tensor, "*rays edges"] | None:
    """Return low + shares (high - low), the inner ones moved by `jitter`; contracted: mapped back to distances."""
    if not takes_bounds(low, high):
        return None
    rays, count = len(low), len(shares)
    out = torch.empty(rays, count, device=low.device)
    if rays:
        shift = shares if jitter is None else jitter  # unused without jitter
        arrays = shares.contiguous(), shift.contiguous(), low.contiguous(), high.contiguous(), out
        block = triton.next_power_of_2(count)
        _stratified[(rays,)](*arrays, TINY, count, jitter is not None, contracted, block, num_warps=_warps(block))
    return out


def interlevel_loss(last: DenseRendering, proposal: DenseRendering) -> Float[Tensor, "*rays"] | None:
    """Return sum_i max(0, w_i - bound_i)^2 / w_i of each ray, with gradients for the proposal's weights."""
    return interlevel(_on_rays(_interlevel), last, proposal)


def distortion_loss(rendering: DenseRendering) -> Float[Tensor, "*rays"] | None:
    """Return sum_ij w_i w_j |m_i - m_j| + sum_i w_i^2 d_i / 3 of each ray, with gradients only for the weights."""
    return distortion(_on_rays(_distortion, rendering.samples.contracted_spacing), rendering)


def trial(device: str = "cuda") -> None:
    """Run every kernel once on tiny input; it raises whatever the compiler or driver raises."""
    edges, weights = torch.tensor([[0.0, 1.0, 2.0]], device=device), torch.ones(1, 2, device=device)
    found = sample_histogram(edges, weights, torch.full((1, 1), 0.5, device=device), 0.01, False)
    stratified_edges(edges[0], edges[:, :1], edges[:, 0], edges[:, 2], True)
    RayLoss.apply(_on_rays(_interlevel), weights, edges, weights, edges)
    RayLoss.apply(_on_rays(_distortion, True), weights, edges)
    if found is None or abs(float(found) - 1.0) > 1e-5:
        raise RuntimeError("a trial of its kernels gave wrong numbers")


def _on_rays(kernel: Any, *flags: bool) -> Callable[..., None]:
    def compute(*arrays: Tensor) -> None:
        (rays, bins), samples = arrays[0].shape, arrays[1].shape[1] - 1  # of weights, and between edges
        block = triton.next_power_of_2(bins)
        kernel[(rays,)](*arrays, bins, samples, *flags, block, LANES, num_warps=_warps(block))

    return compute


def _warps(block: int) -> int:
    return min(8, max(1, block // BINS_OF_A_WARP))


@triton.jit
@no_type_check
def _spaced(distance, contracted: tl.constexpr):
    """Map to the sampling space: `geometry.contraction.normalized_distance`."""
    if contracted:
        distance = tl.where(distance < 1.0, 0.5 * distance, 1.0 - 0.5 / tl.maximum(distance, 1.0))
    return distance


@triton.jit
@no_type_check
def _distance(spaced, tiny, contracted: tl.constexpr):
    """Map from the sampling space: `geometry.contraction.from_normalized_distance`."""
    if contracted:
        spaced = tl.where(spaced < 0.5, 2.0 * spaced, 0.5 / tl.maximum(1.0 - spaced, tiny))
    return spaced


@triton.jit
@no_type_check
def _stratified(
    shares, shift, low, high, out, tiny, count, jittered: tl.constexpr, contracted: tl.constexpr, block: tl.constexpr
):
    ray, k = tl.program_id(0).to(tl.int64), tl.arange(0, block)
    share = tl.load(shares + k, mask=k < count, other=0.0)
    if jittered:  # the first and the last are not moved
        share += tl.load(shift + ray * (count - 2) + k - 1, mask=(k > 0) & (k < count - 1), other=0.0)
    begin, end = tl.load(low + ray), tl.load(high + ray)
    tl.store(out + ray * count + k, _distance(begin + share * (end - begin), tiny, contracted), mask=k < count)


@triton.jit
@no_type_check
def _sample(
    edges, weights, u, out, pad, tiny, bins, count, contracted: tl.constexpr, block: tl.constexpr, lanes: tl.constexpr
):
    ray, bin_index = tl.program_id(0).to(tl.int64), tl.arange(0, block)
    there = bin_index < bins
    mass = tl.where(there, tl.load(weights + ray * bins + bin_index, mask=there, other=0.0) + pad, 0.0)
    share = mass / tl.sum(mass, axis=0)
    above = tl.cumsum(share, axis=0)
    below = above - share
    left = _spaced(tl.load(edges + ray * (bins + 1) + bin_index, mask=there, other=0.0), contracted)
    right = _spaced(tl.load(edges + ray * (bins + 1) + bin_index + 1, mask=there, other=0.0), contracted)
    for start in range(0, count, lanes):
        k = start + tl.arange(0, lanes)
        wanted = tl.load(u + ray * count + k, mask=k < count, other=0.0)
        # The number of bins that end at or before it; the last bin takes what rounding leaves beyond its end.
        number = tl.sum(((above[None, :] <= wanted[:, None]) & there[None, :]).to(tl.int32), axis=1)
        mine = bin_index[None, :] == tl.minimum(number, bins - 1)[:, None]
        first = tl.sum(tl.where(mine, below[None, :], 0.0), axis=1)
        span = tl.sum(tl.where(mine, share[None, :], 0.0), axis=1)
        low = tl.sum(tl.where(mine, left[None, :], 0.0), axis=1)
        high = tl.sum(tl.where(mine, right[None, :], 0.0), axis=1)
        part = tl.where(span > 0.0, (wanted - first) / tl.where(span > 0.0, span, 1.0), 0.5)
        at = low + tl.minimum(tl.maximum(part, 0.0), 1.0) * (high - low)
        tl.store(out + ray * count + k, _distance(at, tiny, contracted), mask=k < count)


@triton.jit
@no_type_check
def _interlevel(v, t, w, u, out, grad, bins, samples, block: tl.constexpr, lanes: tl.constexpr):
    ray, bin_index = tl.program_id(0).to(tl.int64), tl.arange(0, block)
    there = bin_index < bins
    inside = tl.load(v + ray * bins + bin_index, mask=there, other=0.0)
    begin = tl.load(u + ray * (bins + 1) + bin_index, mask=there, other=float("inf"))
    end = tl.load(u + ray * (bins + 1) + bin_index + 1, mask=there, other=float("-inf"))
    loss, of_bins = 0.0, tl.zeros([block], tl.float32)
    for start in range(0, samples, lanes):
        i = start + tl.arange(0, lanes)
        valid = i < samples
        low = tl.load(t + ray * (samples + 1) + i, mask=valid, other=float("inf"))
        high = tl.load(t + ray * (samples + 1) + i + 1, mask=valid, other=float("-inf"))
        weight = tl.load(w + ray * samples + i, mask=valid, other=0.0)
        touches = (begin[None, :] < high[:, None]) & (end[None, :] > low[:, None])
        bound = tl.sum(tl.where(touches, inside[None, :], 0.0), axis=1)
        excess = tl.maximum(weight - bound, 0.0)
        share = excess / (weight + 1e-7)
        loss += tl.sum(excess * share, axis=0)
        of_bins -= tl.sum(tl.where(touches, 2.0 * share[:, None], 0.0), axis=0)
    tl.store(out + ray, loss)
    tl.store(grad + ray * bins + bin_index, of_bins, mask=there)


@triton.jit
@no_type_check
def _distortion(w, edges, out, grad, bins, samples, contracted: tl.constexpr, block: tl.constexpr, lanes: tl.constexpr):
    ray, i = tl.program_id(0).to(tl.int64), tl.arange(0, block)
    there = i < bins
    weight = tl.load(w + ray * bins + i, mask=there, other=0.0)
    row = edges + ray * (bins + 1)
    first, last = _spaced(tl.load(row), contracted), _spaced(tl.load(row + bins), contracted)
    span = tl.maximum(last - first, 1e-6)
    begin = _spaced(tl.load(row + i, mask=there, other=0.0), contracted)
    end = _spaced(tl.load(row + i + 1, mask=there, other=0.0), contracted)
    m, length = (0.5 * (begin + end) - first) / span, (end - begin) / span
    # Sums over the samples before and after each.
    moment = weight * m
    before, behind = tl.cumsum(weight, axis=0) - weight, tl.cumsum(weight, axis=0, reverse=True) - weight
    nearer = m * before - (tl.cumsum(moment, axis=0) - moment)
    farther = tl.cumsum(moment, axis=0, reverse=True) - moment - m * behind
    pairs, own = weight * nearer, weight * weight * length
    tl.store(out + ray, 2.0 * tl.sum(tl.where(there, pairs, 0.0), axis=0) + tl.sum(own, axis=0) / 3.0)
    tl.store(grad + ray * bins + i, 2.0 * (nearer + farther) + weight * length * (2.0 / 3.0), mask=there)

"""Histograms along rays for the CPU: sampling, and the interlevel and distortion losses.

Letters as in `rendering.histograms` and `losses.proposal`; these are the same functions in one pass over each ray.
"""

from collections.abc import Callable
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
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
from nerf_lightning.nerf.kernels.threads import over_rows
from nerf_lightning.nerf.types.renderings import DenseRendering

ZERO, HALF, ONE, TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
LEAST_LEFT = np.float32(TINY)


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
    out = torch.empty(u.shape)
    arrays = (each.detach().contiguous().numpy() for each in (edges, weights, u))
    over_rows(_sample, len(u), *arrays, np.float32(padding), contracted, out.numpy())
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
    out, shift = torch.empty(len(low), len(shares)), torch.empty(len(low), 0) if jitter is None else jitter
    arrays = (each.contiguous().numpy() for each in (shares, shift, low, high))
    over_rows(_stratified, len(low), *arrays, contracted, out.numpy())
    return out


def interlevel_loss(last: DenseRendering, proposal: DenseRendering) -> Float[Tensor, "*rays"] | None:
    """Return sum_i max(0, w_i - bound_i)^2 / w_i of each ray, with gradients for the proposal's weights."""
    return interlevel(_over_rays(_interlevel), last, proposal)


def distortion_loss(rendering: DenseRendering) -> Float[Tensor, "*rays"] | None:
    """Return sum_ij w_i w_j |m_i - m_j| + sum_i w_i^2 d_i / 3 of each ray, with gradients only for the weights."""
    return distortion(_over_rays(_distortion, rendering.samples.contracted_spacing), rendering)


def trial() -> None:
    """Run every kernel once on tiny input; it raises whatever the compiler raises."""
    edges, weights = torch.tensor([[0.0, 1.0, 2.0]]), torch.ones(1, 2)
    sample_histogram(edges, weights, torch.tensor([[0.5]]), 0.01, True)
    stratified_edges(edges[0], torch.zeros(1, 1), edges[:, 0], edges[:, 2], True)
    RayLoss.apply(_over_rays(_interlevel), weights, edges, weights, edges)
    RayLoss.apply(_over_rays(_distortion, True), weights, edges)


def _over_rays(kernel: Any, *flags: bool) -> Callable[..., None]:
    def compute(*arrays: Tensor) -> None:
        over_rows(kernel, len(arrays[0]), *flags, *(each.numpy() for each in arrays))

    return compute


@njit
@no_type_check
def _spaced(distance, contracted):
    # To the sampling space: `geometry.contraction.normalized_distance`.
    if not contracted:
        return distance
    return HALF * distance if distance < ONE else ONE - HALF / distance


@njit
@no_type_check
def _distance(spaced, contracted):
    # From the sampling space: `geometry.contraction.from_normalized_distance`.
    if not contracted:
        return spaced
    return TWO * spaced if spaced < HALF else HALF / max(ONE - spaced, LEAST_LEFT)


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def _stratified(first, last, shares, shift, low, high, contracted, out):
    end, shifted = len(shares) - 1, shift.shape[1] > 0
    for r in range(first, last):
        span = high[r] - low[r]
        for k in range(end + 1):
            share = shares[k]
            if shifted and 0 < k < end:
                share += shift[r, k - 1]
            out[r, k] = _distance(low[r] + share * span, contracted)


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def _sample(first, last, edges, weights, u, padding, contracted, out):
    bins = weights.shape[1]
    for r in range(first, last):
        total = ZERO
        for i in range(bins):
            total += weights[r, i] + padding
        i, below, above = 0, ZERO, (weights[r, 0] + padding) / total
        for k in range(u.shape[1]):
            while i < bins - 1 and above <= u[r, k]:
                i += 1
                below, above = above, above + (weights[r, i] + padding) / total
            span = above - below
            part = min(max((u[r, k] - below) / span, ZERO), ONE) if span > ZERO else HALF
            left, right = _spaced(edges[r, i], contracted), _spaced(edges[r, i + 1], contracted)
            out[r, k] = _distance(left + part * (right - left), contracted)


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def _interlevel(first, last, v, t, w, u, out, grad):
    bins, samples = v.shape[1], w.shape[1]
    total = np.zeros(bins + 1, np.float32)
    for r in range(first, last):
        for j in range(bins):
            total[j + 1] = total[j] + v[r, j]
            grad[r, j] = ZERO
        loss, low, high = ZERO, 0, 0
        for i in range(samples):
            while low <= bins and u[r, low] <= t[r, i]:
                low += 1
            while high <= bins and u[r, high] < t[r, i + 1]:
                high += 1
            start, end = min(max(low - 1, 0), bins), min(high, bins)
            excess = max(w[r, i] - (total[end] - total[start]), ZERO)
            if excess > ZERO:
                share = excess / (w[r, i] + np.float32(1e-7))
                loss += excess * share
                for j in range(start, end):
                    grad[r, j] -= TWO * share
        out[r] = loss


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def _distortion(first, last, contracted, w, edges, out, grad):
    samples, at = w.shape[1], np.empty(w.shape[1] + 1, np.float32)
    for r in range(first, last):
        for i in range(samples + 1):
            at[i] = _spaced(edges[r, i], contracted)
        start, span = at[0], max(at[samples] - at[0], np.float32(1e-6))
        before = moment = pairs = own = ZERO
        for i in range(samples):
            m, length = (HALF * (at[i] + at[i + 1]) - start) / span, (at[i + 1] - at[i]) / span
            nearer = m * before - moment
            pairs += w[r, i] * nearer
            own += w[r, i] * w[r, i] * length
            grad[r, i] = TWO * nearer + TWO * w[r, i] * length / np.float32(3.0)
            before += w[r, i]
            moment += w[r, i] * m
        behind = later = ZERO
        for i in range(samples - 1, -1, -1):
            m = (HALF * (at[i] + at[i + 1]) - start) / span
            grad[r, i] += TWO * (later - m * behind)
            behind += w[r, i]
            later += w[r, i] * m
        out[r] = TWO * pairs + own / np.float32(3.0)

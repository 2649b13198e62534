"""The small kernels of a step against what they stand for: random numbers, histograms, lenses, exponentials."""

import numpy as np
import pytest
import torch

from nerf_lightning.nerf.geometry.lenses import project_plane, unproject
from nerf_lightning.nerf.kernels.backends import without
from nerf_lightning.nerf.kernels.render.exponential import absorbed, exponentials, sigmoids
from nerf_lightning.nerf.losses.proposal import distortion_loss, interlevel_loss
from nerf_lightning.nerf.randomness import batch_random, fold, permute
from nerf_lightning.nerf.rendering.histograms import sample_histogram
from nerf_lightning.nerf.samplers.stratified import stratified_edges
from nerf_lightning.nerf.types.rays import RaySamples
from nerf_lightning.nerf.types.renderings import DenseRendering

KERNELS = ("random.cpu", "histograms.cpu", "lenses.cpu")


def both(compute):
    with without(*KERNELS):
        plain = compute()
    return compute(), plain


@pytest.mark.parametrize(("first", "key"), [(0, 0), (2**31 - 3, 2**32 - 1)])
def test_random_numbers_are_the_same_to_the_bit(first, key):
    ours, plain = both(lambda: batch_random(key, 700, first=first).uniform("jitter", 5))
    assert torch.equal(ours, plain)


@pytest.mark.parametrize("size", [1, 2, 10, 1023, 5000, 2**40 + 7])
def test_permutations_are_the_same_to_the_bit(size):
    index = torch.arange(min(size, 3000))
    ours, plain = both(lambda: permute(index, size, torch.tensor([fold(3, "rays")])))
    assert torch.equal(ours, plain)


def a_histogram(rays=200, bins=9):
    edges = torch.rand(rays, bins + 1).cumsum(dim=-1)
    weights = torch.rand(rays, bins).pow(8)
    weights[:3] = torch.tensor([[0.0], [1.0], [1e-9]])
    return edges, weights


@pytest.mark.parametrize("contracted", [False, True])
@pytest.mark.parametrize("padding", [0.0, 1e-5, 0.01])
def test_samples_come_from_where_the_histogram_says(padding, contracted):
    edges, weights = a_histogram()
    u = torch.rand(200, 12).sort(dim=-1).values
    ours, plain = both(lambda: sample_histogram(edges[1:], weights[1:], u[1:], padding, contracted))
    torch.testing.assert_close(ours, plain, atol=2e-5, rtol=1e-4)
    assert bool((ours.diff(dim=-1) >= 0).all())


@pytest.mark.parametrize("jittered", [False, True])
@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (0.1, 0.999999)])
@pytest.mark.parametrize("contracted", [False, True])
def test_strata_are_the_same_to_the_bit(jittered, low, high, contracted):
    jitter = (torch.rand(300, 6) - 0.5) / 7 if jittered else None
    ends = torch.full((300,), low), torch.full((300,), high) - 0.05 * torch.arange(300) / 300
    ours, plain = both(lambda: stratified_edges(torch.linspace(0, 1, 8), jitter, *ends, contracted))
    assert torch.equal(ours, plain)
    assert bool((ours.diff(dim=-1) > 0).all())


def a_rendering(edges, weights, contracted=False):
    none = torch.zeros(len(edges))
    color = torch.zeros(len(edges), 3)
    return DenseRendering(color, color, none, none, weights=weights, samples=RaySamples(edges, contracted))


@pytest.mark.parametrize("contracted", [False, True])
def test_losses_of_proposals_and_their_gradients_are_those_of_torch(contracted):
    edges, weights = a_histogram()
    t = torch.rand(200, 6).mul(5.0).sort(dim=-1).values
    t[:5] = edges[:5, 2:8]  # fenceposts that coincide
    leaves = [weights.requires_grad_(), (0.3 * torch.rand(200, 5)).requires_grad_()]

    def lost():
        proposal, last = a_rendering(edges, leaves[0], contracted), a_rendering(t, leaves[1], contracted)
        per_ray = torch.stack([interlevel_loss(last, proposal), distortion_loss(last)])
        scaled = (per_ray * torch.arange(1.0, 201.0)).sum()
        return per_ray.detach(), *torch.autograd.grad(scaled, leaves)

    for ours, plain in zip(*both(lost), strict=True):
        assert bool(plain.any())
        torch.testing.assert_close(ours, plain, atol=5e-4, rtol=1e-3)  # sums taken back leave as much


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_distortion_is_taken_away_as_torch_does(dtype):
    lens = torch.tensor([[0.1, -0.05, 0.01, 0.0, 0.002, -0.001], [-0.3, 0.1, 0.0, 0.0, 0.0, 0.0]], dtype=dtype)
    plane = torch.rand(2, 50, 2, dtype=dtype) - 0.5
    ours, plain = both(lambda: unproject(plane, lens[:, None], "radial_tangential"))
    torch.testing.assert_close(ours, plain)
    torch.testing.assert_close(project_plane(ours, lens[:, None], "radial_tangential"), plane, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize(("count", "spread"), [(1, 1.0), (17, 0.01), (128, 30.0), (128, 200.0)])
def test_exponentials_are_exact_but_for_the_last_bits(count, spread):
    x = (spread * np.random.default_rng(0).standard_normal(count)).astype(np.float32)
    out, bits, exact = np.empty_like(x), np.empty(count, np.int32), x.astype(np.float64)
    exponentials(x, out, bits)
    np.testing.assert_allclose(out, np.exp(exact.clip(-87.0, 88.0)), rtol=2e-7)
    absorbed(np.abs(x), out, bits)
    np.testing.assert_allclose(out, -np.expm1(-np.abs(exact)), rtol=1e-5, atol=1e-37)
    sigmoids(x.copy(), out, bits)
    np.testing.assert_allclose(out, 1.0 / (1.0 + np.exp(-exact.clip(-88.0, 87.0))), rtol=3e-7)


def test_exponentials_of_what_is_no_number_are_none():
    x, out, bits = np.array([np.nan, np.inf, -np.inf], np.float32), np.empty(3, np.float32), np.empty(3, np.int32)
    exponentials(x, out, bits)
    assert np.isnan(out[0])
    assert out[1] > 1e38
    assert out[2] < 1e-37


def test_nothing_is_divided_by_to_an_exception():
    assert not sample_histogram(torch.tensor([[0.0, 1.0]]), torch.zeros(1, 1), torch.tensor([[0.5]]), 0.0).isinf().any()
    folding = torch.tensor([[-1.0, 0.0, 0.0, 0.0, 0.0, 0.0]])  # 1 + k r^2 is 0 at r = 1
    assert not unproject(torch.tensor([[1.0, 0.0]]), folding, "radial_tangential")[:, :2].isfinite().all()

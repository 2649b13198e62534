import numpy as np
import pytest
import torch
from support.scenes import some_rays

from nerf_lightning.nerf.rendering.histograms import sample_histogram
from nerf_lightning.nerf.rendering.ray_statistics import (
    effective_samples,
    median_distances,
    transmittance_at,
    weight_along,
)
from nerf_lightning.nerf.types.rays import RaggedSamples, RayBundle, RaySamples
from nerf_lightning.nerf.types.renderings import DenseRendering, RaggedRendering


def straight_rays(count, near=0.0, far=1.0):
    rays = some_rays(count)
    return RayBundle(
        rays.origins, rays.directions, torch.full((count,), near), torch.full((count,), far),
        rays.view_directions,
    )  # fmt: skip


def seen(weights, samples, rays, kind=DenseRendering):
    nothing = torch.zeros(rays.near.numel())
    color = torch.zeros(rays.near.numel(), 3)
    return kind(rgb=color, foreground=color, opacity=nothing, depth=nothing, weights=weights, samples=samples)


def dense(weights, near=0.0, far=1.0):
    rays = straight_rays(len(weights), near, far)
    edges = torch.linspace(near, far, weights.shape[1] + 1).expand(len(weights), -1)
    return seen(weights, RaySamples(edges), rays), rays


def packed(weights, near=0.0, far=1.0):
    """The same samples, ray after ray, those without weight left out, and two of padding behind them."""
    rays = straight_rays(len(weights), near, far)
    edges = torch.linspace(near, far, weights.shape[1] + 1)
    ray, place = weights.nonzero(as_tuple=True)
    bounds = torch.cat([torch.zeros(1, dtype=torch.long), (weights > 0).sum(1).cumsum(0)])
    padding = torch.zeros(2)
    samples = RaggedSamples(
        torch.cat([ray, torch.zeros(2, dtype=torch.long)]), torch.cat([edges[:-1][place], padding]),
        torch.cat([edges[1:][place], padding]), bounds, bounds[-1],
    )  # fmt: skip
    return seen(torch.cat([weights[ray, place], padding]), samples, rays, RaggedRendering), rays


@pytest.mark.parametrize("kind", [dense, packed])
def test_effective_samples_are_as_many_as_share_the_light(kind):
    weights = torch.zeros(4, 10)
    weights[0, 3] = 0.7
    weights[1, :5] = 0.1
    weights[2] = 0.05
    assert effective_samples(*kind(weights)).tolist() == pytest.approx([1.0, 5.0, 10.0, 0.0])


@pytest.mark.parametrize("kind", [dense, packed])
def test_weight_lies_where_the_samples_are(kind):
    weights = torch.zeros(2, 8)
    weights[0, 1], weights[1, 6], weights[1, 7] = 1.0, 0.5, 0.25
    assert weight_along(*kind(weights, near=2.0, far=6.0), bins=4).tolist() == [0.5, 0.0, 0.0, 0.375]


@pytest.mark.parametrize("kind", [dense, packed])
def test_the_median_lies_in_what_is_seen_and_not_between(kind):
    weights = torch.zeros(4, 10)
    weights[0, 1], weights[0, 8] = 0.3, 0.6
    weights[1, 1], weights[1, 8] = 0.6, 0.3
    weights[3] = 0.1
    assert median_distances(*kind(weights)).tolist() == pytest.approx([0.85, 0.15, 1.0, 0.45])


@pytest.mark.parametrize("kind", [dense, packed])
def test_the_light_at_a_distance_is_what_nothing_before_it_has_stopped(kind):
    weights = torch.zeros(3, 4)
    weights[0, 0], weights[0, 2], weights[1, 3] = 0.25, 0.5, 1.0
    rendering, rays = kind(weights, near=2.0, far=6.0)
    assert transmittance_at(rendering, rays, torch.tensor([4.0, 6.0, 6.0])).tolist() == [0.75, 0.0, 1.0]
    assert transmittance_at(rendering, rays, torch.tensor([2.0, 5.0, 2.0])).tolist() == [1.0, 1.0, 1.0]


def test_many_rays_do_not_blur_the_median():
    weights = torch.full((20_000, 5), 1e-4)
    weights[:, 3] = 0.9
    assert bool((median_distances(*dense(weights)) - 0.7).abs().max() < 1e-6)


def test_without_bounds_the_parts_are_those_of_the_spacing():
    """Far is at 1 - 1 / 2000 of the spacing: 500 lies at 0.9995 of the way, though at half of the distance."""
    weights = torch.zeros(1, 2)
    weights[0, 0] = 1.0
    rendering, rays = dense(weights, near=0.0, far=1000.0)
    assert weight_along(rendering, rays, bins=4).tolist() == [0.0, 1.0, 0.0, 0.0]
    assert weight_along(rendering, rays, bins=4, contracted_spacing=True).tolist() == [0.0, 0.0, 0.0, 1.0]


def test_inverse_sampling_equals_numpy_interpolation(generator):
    edges = torch.rand(6, 21, generator=generator, dtype=torch.float64).cumsum(-1)
    weights = torch.rand(6, 20, generator=generator, dtype=torch.float64) + 0.01
    u = torch.rand(6, 50, generator=generator, dtype=torch.float64)
    ours = sample_histogram(edges, weights, u, padding=0.0)
    for row in range(6):
        cdf = np.concatenate([[0], np.cumsum(weights[row].numpy()) / weights[row].sum().item()])
        np.testing.assert_allclose(ours[row].numpy(), np.interp(u[row].numpy(), cdf, edges[row].numpy()), atol=1e-12)


def test_an_empty_ray_is_sampled_evenly():
    samples = sample_histogram(torch.linspace(2, 6, 65), torch.zeros(64), (torch.arange(64) + 0.5) / 64)
    torch.testing.assert_close(samples, 2 + 4 * (torch.arange(64) + 0.5) / 64, atol=1e-4, rtol=0)

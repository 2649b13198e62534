from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene, some_rays

from nerf_lightning.nerf.geometry.contraction import normalized_distance as normalized
from nerf_lightning.nerf.randomness import batch_random, fold
from nerf_lightning.nerf.rendering.quadrature import composite
from nerf_lightning.nerf.samplers.importance import ImportanceSampler
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler
from nerf_lightning.nerf.types.renderings import FieldOutput


def coarse_rendering(rays, density_at):
    samples = StratifiedSampler(64)(rays, [], None)
    density = density_at(samples.midpoints)
    return composite(FieldOutput(density, torch.zeros(*density.shape, 3)), samples, rays, torch.ones(3))


def test_at_evaluation_samples_are_the_midpoints_of_equal_intervals():
    """The fault: validation that is jittered."""
    rays = some_rays(3)
    samples = StratifiedSampler(4)(rays, [], None)
    torch.testing.assert_close(samples.midpoints, torch.tensor([2.5, 3.5, 4.5, 5.5]).expand(3, -1))


def test_jitter_is_fresh_for_every_ray_and_step():
    """The fault: one jitter for all rays, or drawn once."""
    rays, sampler = some_rays(50), StratifiedSampler(16)
    first = sampler(rays, [], batch_random(fold(0, 0, 0), 50)).edges
    second = sampler(rays, [], batch_random(fold(0, 0, 1), 50)).edges
    assert first.unique(dim=0).shape[0] == 50
    assert float((first[:, 1:-1] == second[:, 1:-1]).float().mean()) < 0.01


def test_stratified_fenceposts_stay_in_their_strata_and_cover_the_ray():
    rays, sampler = some_rays(2000), StratifiedSampler(8)
    edges = sampler(rays, [], batch_random(1, 2000)).edges
    place = (edges[:, 1:-1] - 2.0) / 4.0 * 8  # inner fencepost i lies in (i - 0.5, i + 0.5)
    offset = place - torch.arange(1, 8)
    assert bool((offset.abs() <= 0.5 + 1e-5).all())
    assert float(offset.std() * 12**0.5) == pytest.approx(1.0, abs=0.02)  # uniform in the stratum
    assert bool((edges[:, 0] == 2.0).all())
    assert bool((edges[:, -1] == 6.0).all())


def test_importance_keeps_the_coarse_fenceposts_and_adds_its_own_sorted():
    rays = some_rays(5)
    coarse = coarse_rendering(rays, lambda t: 3.0 * (t > 4).float())
    fine = ImportanceSampler(128)(rays, [coarse], batch_random(2, 5))
    assert fine.edges.shape == (5, 64 + 1 + 128)
    assert bool((fine.edges.diff(dim=-1) >= 0).all())
    for row in range(5):
        assert bool(torch.isin(coarse.samples.edges[row], fine.edges[row]).all())


@pytest.mark.parametrize("place", [2.6, 3.3, 4.1, 5.4])
def test_importance_puts_its_samples_where_the_coarse_level_saw_a_surface(place):
    """The fault: weights and bins misaligned by one; the samples would lie beside the surface."""
    rays = some_rays(4)
    coarse = coarse_rendering(rays, lambda t: 1e4 * ((t > place) & (t < place + 0.0625)).float())
    added = ImportanceSampler(128)(rays, [coarse], batch_random(2, 4)).edges
    hit = coarse.weights.argmax(dim=-1)
    low = coarse.samples.edges.gather(-1, hit[:, None])
    high = coarse.samples.edges.gather(-1, hit[:, None] + 1)
    inside = ((added >= low) & (added <= high)).sum(dim=-1)
    assert bool((inside >= 120).all())


def test_no_gradient_flows_through_the_sampled_positions():
    """The fault: gradients through the positions of the fine samples."""
    rays = some_rays(4)
    density = torch.rand(4, 64, requires_grad=True)
    samples = StratifiedSampler(64)(rays, [], None)
    coarse = composite(FieldOutput(density, torch.zeros(4, 64, 3)), samples, rays, torch.ones(3))
    assert coarse.weights.requires_grad
    assert not ImportanceSampler(16)(rays, [coarse], batch_random(0, 4)).edges.requires_grad


def test_importance_ignores_light_that_a_closed_ray_gives_to_its_last_interval():
    rays = some_rays(3)
    samples = StratifiedSampler(64)(rays, [], None)
    empty = composite(FieldOutput(torch.zeros(3, 64), torch.zeros(3, 64, 3)), samples, rays, None)
    fine = ImportanceSampler(62)(rays, [empty], None).edges
    assert bool((torch.histc(fine, 62, 2.0625, 5.9375) >= 3).all())  # evenly spread, not heaped at far


def endless_rays(count):
    rays = some_rays(count)
    return replace(rays, near=torch.full((count,), 0.1), far=torch.full((count,), 16.0))


@pytest.mark.parametrize("random", [None, batch_random(3, 20)])
def test_in_contracted_scenes_samples_are_even_in_disparity(random):
    sampler, rays = StratifiedSampler(32), endless_rays(20)
    sampler.fit_to(replace(ball_scene(), space="contracted"))
    samples = sampler(rays, [], random)
    assert samples.contracted_spacing
    torch.testing.assert_close(samples.edges[:, 0], rays.near)
    torch.testing.assert_close(samples.edges[:, -1], rays.far)
    even = (
        normalized(rays.near)[:, None]
        + torch.linspace(0, 1, 33) * (normalized(rays.far) - normalized(rays.near))[:, None]
    )
    within = 1e-6 if random is None else 0.5 * float(even[0, 1] - even[0, 0]) + 1e-6
    assert float((normalized(samples.edges) - even).abs().max()) <= within
    assert bool((samples.deltas > 0).all())


@pytest.mark.parametrize("space", ["bounded", "ndc"])
def test_in_other_scenes_samples_are_even_in_distance(space):
    sampler, rays = StratifiedSampler(8), endless_rays(2)
    sampler.fit_to(replace(ball_scene(), space=space))
    samples = sampler(rays, [], None)
    assert not samples.contracted_spacing
    torch.testing.assert_close(samples.deltas, torch.full((2, 8), 15.9 / 8))


def test_importance_samples_remember_that_space_has_no_end():
    sampler, rays = StratifiedSampler(16), endless_rays(4)
    sampler.fit_to(replace(ball_scene(), space="contracted"))
    samples = sampler(rays, [], None)
    seen = composite(FieldOutput(torch.rand(4, 16), torch.rand(4, 16, 3)), samples, rays, torch.ones(3))
    assert ImportanceSampler(8)(rays, [seen], None).contracted_spacing

import math
from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene, some_rays

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.contraction import normalized_distance
from nerf_lightning.nerf.randomness import batch_random, fold
from nerf_lightning.nerf.rendering.quadrature import composite
from nerf_lightning.nerf.samplers.importance import ImportanceSampler
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler
from nerf_lightning.nerf.samplers.proposal import ProposalSampler
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler
from nerf_lightning.nerf.types.renderings import FieldOutput


def coarse_rendering(rays, density_at):
    samples = StratifiedSampler(64)(rays, [], None)
    density = density_at(samples.midpoints)
    return composite(FieldOutput(density, torch.zeros(*density.shape, 3)), samples, rays, torch.ones(3))


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


@pytest.mark.parametrize("sampler", [ImportanceSampler(16), ProposalSampler(8)])
def test_no_gradient_flows_through_the_sampled_positions(sampler):
    """The fault: gradients through the positions of the fine samples."""
    rays = some_rays(4)
    density = torch.rand(4, 64, requires_grad=True)
    samples = StratifiedSampler(64)(rays, [], None)
    coarse = composite(FieldOutput(density, torch.zeros(4, 64, 3)), samples, rays, torch.ones(3))
    assert coarse.weights.requires_grad
    assert not sampler(rays, [coarse], batch_random(0, 4)).edges.requires_grad


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
    low = normalized_distance(rays.near)
    even = low[:, None] + torch.linspace(0, 1, 33) * (normalized_distance(rays.far) - low)[:, None]
    within = 1e-6 if random is None else 0.5 * float(even[0, 1] - even[0, 0]) + 1e-6
    assert float((normalized_distance(samples.edges) - even).abs().max()) <= within
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


def proposal(rays, place=4.0):
    samples = StratifiedSampler(64)(rays, [], None)
    density = 200.0 * ((samples.midpoints - place).abs() < 0.1).float()
    return composite(FieldOutput(density, torch.zeros(*density.shape, 3)), samples, rays, None)


@pytest.mark.parametrize("random", [None, batch_random(4, 30)])
def test_it_samples_where_the_proposal_saw_something_and_a_little_elsewhere(random):
    rays = some_rays(30)
    samples = ProposalSampler(32)(rays, [proposal(rays)], random)
    assert samples.edges.shape == (30, 33)
    assert bool((samples.deltas >= 0).all())
    near_surface = ((samples.edges - 4.0).abs() < 0.2).float().mean()
    assert 0.4 < float(near_surface) < 1.0
    assert bool(((samples.edges >= 2.0) & (samples.edges <= 6.0)).all())


def test_without_an_end_it_spreads_its_samples_in_disparity():
    rays = replace(some_rays(30), near=torch.full((30,), 0.1), far=torch.full((30,), 100.0))
    stratified = StratifiedSampler(64)
    stratified.fit_to(replace(ball_scene(), space="contracted"))
    samples = stratified(rays, [], None)
    seen = composite(FieldOutput(torch.zeros(30, 64), torch.zeros(30, 64, 3)), samples, rays, torch.ones(3))
    found = ProposalSampler(32)(rays, [seen], None)
    assert found.contracted_spacing
    # A proposal that saw nothing asks for even steps of the spacing, of which half lie within distance 1.
    steps = normalized_distance(found.edges).diff(dim=-1)
    torch.testing.assert_close(steps, steps.mean().expand_as(steps), rtol=0.02, atol=0)
    assert 0.4 < float((found.edges < 1.0).float().mean()) < 0.5
    assert bool(((found.edges >= 0.1) & (found.edges <= 100.01)).all())


def a_sampler(scene=None, **settings):
    sampler = OccupancySampler(**({"resolution": 16, "num_steps": 64, "min_alpha": 0.01} | settings))
    sampler.fit_to(scene or opaque_ball())
    return sampler


def opaque_ball():
    scene = ball_scene(num_views=6, size=16)
    rgba = scene.pixels.rgba.clone()
    rgba[:, 3] = 255
    return replace(scene, pixels=replace(scene.pixels, rgba=rgba, has_transparency=False))


def ball_density(radius=0.5, density=80.0):
    return lambda positions: density * (positions.norm(dim=-1) < radius).float()


def learn(sampler, density_fn, steps=320):
    for step in range(16, steps + 1, 16):
        sampler.learn(density_fn, step, fold(0, 0, step))
    return sampler


def test_the_grid_finds_what_is_there_and_forgets_what_is_not():
    sampler = learn(a_sampler(), ball_density())
    centers, _ = sampler.grid.cell_centers()
    occupied = sampler.grid.cells.flatten().bool()
    cell = 2.0 / 16
    assert bool(occupied[centers.norm(dim=-1) < 0.5 - cell].all())
    assert not bool(occupied[centers.norm(dim=-1) > 0.5 + cell].any())
    learn(sampler, ball_density(radius=0.2), 6000)
    occupied = sampler.grid.cells.flatten().bool()
    assert bool(occupied.any())
    assert not bool(occupied[centers.norm(dim=-1) > 0.2 + cell].any())


def test_matter_that_grows_later_is_found_again():
    """The fault: a cell that was given up once is never asked again."""
    sampler = learn(a_sampler(), ball_density(radius=0.2))
    before = int(sampler.grid.cells.sum())
    for step in range(400, 700, 16):
        sampler.learn(ball_density(radius=0.6), step, fold(0, 0, step))
    assert int(sampler.grid.cells.sum()) > 5 * before


def test_nothing_is_given_up_before_its_time():
    """Dark content on a black background: its density grows late, and must not be pruned first."""
    sampler = a_sampler(prune_after=100)
    for step in (16, 32, 96):
        sampler.learn(ball_density(density=0.0), step, step)
    assert bool(sampler.grid.cells.all())
    sampler.learn(ball_density(), 112, 112)
    assert not bool(sampler.grid.cells.all())


def test_a_density_that_is_the_same_everywhere_prunes_nothing():
    sampler = a_sampler()
    sampler.learn(lambda positions: torch.full(positions.shape[:-1], 0.3), 16, 5)
    assert bool(sampler.grid.cells.all())


def test_the_update_is_a_function_of_the_step():
    grids = [learn(a_sampler(), ball_density()).grid.density for _ in range(2)]
    assert torch.equal(*grids)
    assert not torch.equal(grids[0], learn(a_sampler(), ball_density(), 336).grid.density)


def test_jitter_is_fresh_for_every_ray_and_step_and_absent_at_evaluation():
    sampler, rays = a_sampler(), some_rays(50)
    first = sampler.start(rays, batch_random(fold(0, 0, 0), 50)).jitter
    second = sampler.start(rays, batch_random(fold(0, 0, 1), 50)).jitter
    assert first.unique().numel() == 50
    assert not torch.equal(first, second)
    assert bool((sampler.start(rays, None).jitter == 0).all())


def test_a_box_that_no_camera_sees_and_cameras_inside_of_it_are_said_by_name(caplog):
    scene = opaque_ball()
    with pytest.raises(InputError, match=r"box of the scene ball.*no camera sees it.*scene\.aabb_half"):
        a_sampler(replace(scene, aabb=scene.aabb + 500.0))
    a_sampler(replace(scene, aabb=5 * scene.aabb))
    assert "3 of 3 training cameras are inside the box of the scene ball" in caplog.text
    caplog.clear()
    a_sampler(scene)
    assert caplog.text == ""


def test_a_scene_without_a_box_is_refused_with_the_model_for_it():
    with pytest.raises(InputError, match=r"photographs of ball show .* Use model=fast_proposal \(or model=auto\)"):
        a_sampler(replace(opaque_ball(), space="contracted"))


def test_in_normalised_device_coordinates_every_cell_is_possible():
    """Cells are not where the cameras see them: a box behind all cameras must not be carved away."""
    scene = opaque_ball()
    sampler = a_sampler(replace(scene, space="ndc", aabb=scene.aabb + 500.0))
    assert bool(sampler.grid.possible.all())


def test_the_centre_of_a_cell_is_the_middle_of_its_positions():
    """Bit for bit: carving asks about the centers, training about points in the same cells."""
    sampler = OccupancySampler(resolution=12)
    sampler.grid.aabb.copy_(torch.tensor([[-1.1, -0.7, -0.3], [0.9, 1.7, 1.1]]))
    centers, half_diagonal = sampler.grid.cell_centers()
    assert torch.equal(centers, sampler.grid.positions(torch.arange(12**3), torch.full((1, 3), 0.5)))
    assert half_diagonal == pytest.approx(math.hypot(2.0, 2.4, 1.4) / 24)

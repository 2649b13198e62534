from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch
from support.known_fields import SolidField, ball
from support.scenes import ball_scene, some_rays, tiny_field, tiny_model
from support.static_models import fast_model

from nerf_lightning.nerf.models.dense_level import DenseLevel
from nerf_lightning.nerf.models.masked_level import MaskedLevel
from nerf_lightning.nerf.models.proposal_level import ProposalLevel
from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.models.ragged_level import RaggedLevel, SampleCounter
from nerf_lightning.nerf.models.tiles import tile_rays_for, tiles
from nerf_lightning.nerf.part import StepContext, begin_step, fit_parts, statistics
from nerf_lightning.nerf.randomness import batch_random
from nerf_lightning.nerf.rendering.sample_points import ragged_points
from nerf_lightning.nerf.samplers.early_termination import visible_samples
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler


def test_levels_run_in_order_ray_by_ray_and_the_fine_one_sees_the_union():
    model = tiny_model()
    renderings = model(some_rays(5), torch.ones(5, 3), batch_random(0, 5))
    assert model.level_names == ("coarse", "fine")
    assert [r.weights.shape[-1] for r in renderings] == [8, 16]
    assert model.points_per_ray(training=True) == 16
    assert isinstance(model, RadianceModel)
    model, rays, background = tiny_model(), some_rays(7), torch.rand(7, 3)
    whole = model(rays, background, batch_random(4, 7))[-1]
    one = model(rays[3:4], background[3:4], batch_random(4, 7)[3:4])[-1]
    torch.testing.assert_close(whole.rgb[3:4], one.rgb)


def test_tiles_cover_the_batch_evenly():
    for count, size in [(10, 4), (1024, 85), (5, 9), (7, 7)]:
        parts = list(tiles(count, size))
        assert [i for part in parts for i in range(part.start, part.stop)] == list(range(count))
        sizes = [part.stop - part.start for part in parts]
        assert max(sizes) <= size
        assert max(sizes) - min(sizes) <= 1
    assert tile_rays_for(tiny_model(), 8192) == 512
    assert tile_rays_for(tiny_model(), 1) == 1


@pytest.mark.parametrize(("step", "learns"), [(0, True), (9, True), (10, False), (11, False), (12, True), (13, False)])
def test_after_the_first_steps_proposals_learn_now_and_then(step, learns):
    proposal = ProposalLevel(StratifiedSampler(8), tiny_field(), learn_every=4, learn_always=10)
    rays = some_rays(5)
    proposal.on_step(StepContext(0.0, step, 0))
    rendering = proposal(rays, None, [], batch_random(0, 5, rays.near.device))
    assert rendering.weights.requires_grad == learns
    again = ProposalLevel(StratifiedSampler(8), proposal.field)
    assert torch.equal(again(rays, None, [], batch_random(0, 5, rays.near.device)).weights, rendering.weights)


def both(**sampler):
    """The same field and grid in both forms, with some cells empty."""
    scene = ball_scene(num_views=12)
    packed, masked = (
        fast_model(level, num_steps=96, **({"opaque_below": 0.0} | sampler)) for level in (RaggedLevel, MaskedLevel)
    )
    fit_parts(packed, scene)
    torch.nn.init.normal_(packed.levels["fine"].field.position_encoder.table, std=1.0)
    for step in (4, 8, 12):
        begin_step(packed, StepContext(0.0, step, step))
    grid = packed.levels["fine"].sampler.grid
    grid.occupy(grid.density > grid.density.quantile(0.7))
    state = packed.state_dict()
    fit_parts(masked, scene)
    masked.load_state_dict({key: state[key] for key in masked.state_dict()})
    return packed, masked


@pytest.mark.parametrize("background", ["a color", "none"])
@pytest.mark.parametrize("training", [True, False])
def test_it_renders_what_the_packed_level_renders(background, training):
    packed, masked = both()
    rays, behind = some_rays(60), None if background == "none" else torch.rand(60, 3)
    random = batch_random(3, 60) if training else None
    (expected,), (found,) = packed(rays, behind, random), masked(rays, behind, random)
    assert float(expected.opacity.detach().std()) > 0.05
    for name in ("rgb", "foreground", "opacity", "depth"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=1e-4, atol=2e-5)


def test_it_learns_what_the_packed_level_learns():
    """The same gradients."""
    packed, masked = both()
    rays, random = some_rays(60), batch_random(3, 60)
    for model in (packed, masked):
        model(rays, torch.ones(60, 3), random)[0].rgb.square().mean().backward()
    for (name, expected), found in zip(packed.named_parameters(), masked.parameters(), strict=True):
        torch.testing.assert_close(found.grad, expected.grad, rtol=1e-3, atol=1e-6, msg=name)


def test_what_lies_behind_opaque_samples_makes_no_visible_difference():
    packed, masked = both(opaque_below=1e-3)
    rays, white = some_rays(60), torch.ones(60, 3)
    found, expected = (model(rays, white, batch_random(3, 60))[0].rgb for model in (masked, packed))
    assert float((found - expected).detach().abs().max()) < 2e-3


def test_the_grid_keeps_up_with_the_field():
    packed, masked = both()
    for model in (packed, masked):
        for step in (16, 20):
            begin_step(model, StepContext(0.0, step, step))
    pairs = zip(packed.levels["fine"].sampler.buffers(), masked.levels["fine"].sampler.buffers(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)
    assert statistics(masked)["train/occupied"] == statistics(packed)["train/occupied"]


def a_level(**settings):
    torch.manual_seed(1)
    field = tiny_field(density_activation="softplus", density_bias=1.0)
    sampler = OccupancySampler(**({"resolution": 8, "num_steps": 200, "opaque_below": 1e-6} | settings))
    level = RaggedLevel(sampler, field)
    fit_parts(level, ball_scene(num_views=12))
    level.sampler.grid.occupy(torch.ones_like(level.sampler.grid.possible))
    return level


def test_with_every_cell_occupied_it_sees_what_dense_samples_see():
    level, rays, background = a_level(), some_rays(60), torch.rand(60, 3)
    inside = level.sampler.start(rays, None)
    hit = inside.enter < inside.leave
    near, far = inside.enter, torch.maximum(inside.leave, inside.enter + 1e-3)
    dense = DenseLevel(StratifiedSampler(400), level.field)
    boxed = replace(rays, near=near, far=far)
    expected = dense(boxed, background, [], None)
    with torch.no_grad():
        found = level(rays, background, [], None)
    torch.testing.assert_close(found.rgb[hit], expected.rgb[hit].detach(), atol=0.02, rtol=0)
    torch.testing.assert_close(found.opacity[hit], expected.opacity[hit].detach(), atol=0.02, rtol=0)
    torch.testing.assert_close(found.rgb[~hit], background[~hit])


@pytest.mark.parametrize(("opaque_below", "apart"), [(1e-6, 2e-5), (1e-3, 4e-3)])
def test_rendering_in_rounds_equals_rendering_at_once(opaque_below, apart):
    """The same lattice, once with gradients (all samples of a ray in one go), once round by round.

    Rounds leave out the color of what is transparent: no difference is as large as one of 255 steps.
    """
    level, rays, background = a_level(opaque_below=opaque_below), some_rays(80), torch.rand(80, 3)
    whole = level(rays, background, [], None)
    with torch.no_grad():
        rounds = level(rays, background, [], None)
    for name in ("rgb", "foreground", "opacity"):
        torch.testing.assert_close(getattr(rounds, name), getattr(whole, name).detach(), atol=apart, rtol=1e-4)
    torch.testing.assert_close(rounds.depth, whole.depth.detach(), atol=10 * apart, rtol=1e-4)


@pytest.mark.parametrize("level", [RaggedLevel, MaskedLevel])
@pytest.mark.parametrize("distance", [2.5, 3.0, 8.0, 800.0])
def test_a_scene_looks_the_same_from_wherever_it_is_seen(level, distance):
    """Rays that lie on the same lines, of photographs 4 units away and of a camera elsewhere, see the same."""
    packed = a_level(resolution=8, num_steps=200, opaque_below=0.0)
    level = packed if level is RaggedLevel else MaskedLevel(packed.sampler, packed.field)
    rays = some_rays(60)
    moved = distance - 4.0
    elsewhere = replace(
        rays, origins=rays.origins - moved * rays.directions,
        near=(rays.near + moved).clamp(min=0.01), far=rays.far + moved,
    )  # fmt: skip
    background = torch.zeros(60, 3)
    with torch.no_grad():
        here, there = level(rays, background, [], None), level(elsewhere, background, [], None)
    assert float(here.opacity.max()) > 0.5
    torch.testing.assert_close(there.opacity, here.opacity, atol=0.03, rtol=0)
    torch.testing.assert_close(there.depth - moved, here.depth, atol=0.05, rtol=0)


def test_samples_end_where_the_ray_is_opaque():
    level, rays = a_level(opaque_below=1e-3), some_rays(300)
    level.field = SolidField(ball(0.5), inside=80.0)
    samples, features = visible_samples(level.sampler, level.field, rays, batch_random(1, 300))
    assert features is None
    every = level.sampler(rays, batch_random(1, 300))
    assert int(samples.found) == samples.starts.numel() < int(every.found)  # something lies behind the surface
    density, _ = level.field.density(ragged_points(rays, samples, None))
    optical = torch.zeros(300).index_add(0, samples.ray_index, density * samples.deltas)
    longest = 80.0 * level.sampler.step_size
    assert 1.0 < float(optical.max()) <= -torch.tensor(1e-3).log() + longest + 1e-3


def test_tiles_change_nothing_but_rounding():
    level, rays, random = a_level(), some_rays(50), batch_random(3, 50)
    background = torch.rand(50, 3)
    whole = level(rays, background, [], random).rgb
    parts = [level(rays[part], background[part], [], random[part]).rgb for part in (slice(0, 20), slice(20, 50))]
    torch.testing.assert_close(torch.cat(parts), whole)


def test_samples_per_ray_are_measured_kept_and_loaded():
    level = a_level()
    model = RadianceModel({"fine": level})
    assert model.points_per_ray(training=True) == 200  # nothing known yet: the most there can be
    model(some_rays(50), torch.ones(50, 3), batch_random(0, 50))
    begin_step(model, StepContext(0.0, 16, 0))
    counted = model.points_per_ray(training=True)
    assert 5 < counted < 150
    other = RadianceModel({"fine": a_level()})
    other.load_state_dict(model.state_dict())
    assert other.points_per_ray(training=True) == counted
    assert statistics(model)["speed/samples_per_ray"] == pytest.approx(counted)
    assert model.points_per_ray(training=False) == 1
    model.last.counter.reset_statistics()
    assert model.points_per_ray(training=True) == 200


def test_tiles_of_pictures_on_a_gpu_are_cut_by_the_samples_that_their_rays_will_find():
    level = a_level()
    model, level.counter = RadianceModel({"fine": level}), SampleCounter()
    del level.counter.mean
    level.counter.mean, level.counter._per_ray = Mock(device=torch.device("cuda")), 3.0
    assert tile_rays_for(model, 1200) == 1200 / 3 / 4

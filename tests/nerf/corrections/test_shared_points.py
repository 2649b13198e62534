"""Exposures in closed form: pairs of pixels show one point, and what most of them say is found."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from support.planted_exposures import random_stops, with_stops
from support.scenes import BALL_RADIUS, ball_scene
from support.steps import make_step, rays_of

from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.nerf.corrections.exposure import FAR, Exposure
from nerf_lightning.nerf.corrections.shared_points import Pairs, shared_points, solved_stops
from nerf_lightning.nerf.geometry.cameras import rays_through_pixels

VIEWS, SIZE = 32, 40


@pytest.fixture(autouse=True)
def few_points(monkeypatch):
    monkeypatch.setattr("nerf_lightning.nerf.corrections.shared_points.POINTS", 4096)


def looking(scene):
    """What tells where rays meet the ball, exactly."""

    def look(pixels):
        rays = rays_through_pixels(scene.cameras, pixels, scene.near, scene.far)
        along = -(rays.origins * rays.directions).sum(-1)
        half = BALL_RADIUS**2 - (rays.origins + along[:, None] * rays.directions).square().sum(-1)
        return rays.origins + (along - half.clamp(min=0).sqrt())[:, None] * rays.directions, (half > 0).float()

    return look


def made_pairs(stops, count=4000, seed=0):
    """Pairs of random photographs that show the same light under these stops."""
    draw = torch.Generator().manual_seed(seed)
    view = torch.stack([torch.randint(len(stops), (count,), generator=draw) for _ in range(2)], dim=1)
    light = (-3.0 * torch.rand(count, 1, 3, generator=draw) + stops[view]).double()
    return Pairs(view, light, torch.ones(count, 3, dtype=torch.bool)), draw


def centred(stops):
    return stops - stops.mean(dim=0)


def test_exact_pairs_give_exact_stops_up_to_their_mean():
    stops = torch.randn(20, 3, generator=torch.Generator().manual_seed(1))
    found = solved_stops(made_pairs(stops)[0], torch.zeros(20, 3))
    torch.testing.assert_close(centred(found), centred(stops), atol=1e-4, rtol=0)
    assert float(found.mean(dim=0).abs().max()) < 1e-4


def test_a_third_of_pairs_that_are_far_off_to_one_side_hardly_count():
    """As highlights are, which are brighter from one side alone."""
    stops = torch.randn(20, 3, generator=torch.Generator().manual_seed(1))
    pairs, draw = made_pairs(stops)
    shines = (torch.rand(len(pairs.view), 1, generator=draw) < 1 / 3) & (pairs.view[:, :1] < pairs.view[:, 1:])
    light = pairs.light + 0.02 * torch.randn(pairs.light.shape, generator=draw)
    light[:, 0] += shines * 1.5
    found = solved_stops(replace(pairs, light=light), torch.zeros(20, 3))
    assert float((centred(found) - centred(stops)).abs().max()) < 0.02


def test_clipped_and_dark_channels_do_not_count():
    stops = torch.randn(12, 3, generator=torch.Generator().manual_seed(1))
    pairs, draw = made_pairs(stops)
    clipped = torch.rand(len(pairs.view), 3, generator=draw) < 0.6
    light = torch.where(clipped[:, None], torch.zeros(()).double(), pairs.light)
    dark = torch.rand(len(pairs.view), 3, generator=draw) < 0.3
    light = torch.where(dark[:, None], torch.full((), -9.0).double(), light)
    found = solved_stops(Pairs(pairs.view, light, ~clipped | dark), torch.zeros(12, 3))
    torch.testing.assert_close(centred(found), centred(stops), atol=1e-3, rtol=0)


def test_photographs_that_share_nothing_keep_their_stops():
    stops = torch.randn(10, 3, generator=torch.Generator().manual_seed(1))
    pairs, _ = made_pairs(stops[:8])
    before = 0.1 * torch.randn(10, 3, generator=torch.Generator().manual_seed(2))
    found = solved_stops(pairs, before)
    torch.testing.assert_close(found[8:], before[8:])
    torch.testing.assert_close(centred(found[:8]), centred(stops[:8]), atol=1e-3, rtol=0)
    assert torch.equal(solved_stops(pairs[:0], before), before)


def test_pairs_show_one_point_in_both_photographs():
    scene = ball_scene(VIEWS, SIZE)
    pairs = shared_points(scene, scene.cameras, looking(scene), key=3)
    assert len(pairs.view) > 1000
    assert bool((pairs.view[:, 0] != pairs.view[:, 1]).all())
    assert set(pairs.view.flatten().tolist()) <= set(scene.splits["train"])
    shown = torch.exp2(pairs.light)
    assert float((shown[:, 0] - shown[:, 1]).abs().max()) < 0.25
    other = shared_points(scene, scene.cameras, looking(scene), key=4)
    assert other.view.shape != pairs.view.shape or not torch.equal(other.view, pairs.view)


def test_masked_pixels_and_other_captures_are_not_compared():
    scene = ball_scene(VIEWS, SIZE)
    half = len(scene.splits["train"]) // 2
    mask = torch.ones(len(scene.pixels.rgba), dtype=torch.uint8)
    mask[: int(scene.pixels.offset[1])] = 0
    scene = replace(
        scene,
        pixels=replace(scene.pixels, mask=mask),
        capture_of=tuple(int(view >= half) for view in range(VIEWS)),
        captures=("one", "other"),
    )
    pairs = shared_points(scene, scene.cameras, looking(scene), key=3)
    assert not bool((pairs.view == 0).any())
    assert torch.equal(pairs.view[:, 0] < half, pairs.view[:, 1] < half)
    assert len(pairs.view) > 100


@pytest.fixture
def planted():
    scene = ball_scene(VIEWS, SIZE)
    stops = random_stops(len(scene.splits["train"]))
    return with_stops(scene, stops, dim=0.5), stops


def test_planted_exposures_of_a_ball_are_found(planted):
    scene, stops = planted
    red, green, blue = solved_stops(
        shared_points(scene, scene.cameras, looking(scene), key=0), torch.zeros(VIEWS, 3)
    ).unbind(-1)
    exposure = (red + green + blue) / 3
    found = torch.stack([exposure, red - exposure, blue - exposure], dim=-1)[list(scene.splits["train"])]
    for ours, true in zip(found.T, stops.T, strict=True):
        assert float(torch.corrcoef(torch.stack([ours, true]))[0, 1]) > 0.99


@pytest.fixture
def new_step(planted, monkeypatch):
    """Steps of a run of nine that solves twice, and finds the points where they are."""
    scene, _ = planted
    monkeypatch.setattr(
        "nerf_lightning.nerf.corrections.exposure.surface_points",
        lambda model, rays_of, pixels, _: looking(scene)(pixels),
    )

    def new():
        step = make_step(None)
        step.rays, step.correction, step.num_steps = rays_of(scene), Exposure(solves=2), 9
        step.correction.fit_to(scene)
        step.build_optimizer = lambda groups: torch.optim.Adam(groups, lr=1e-3)
        return step, step.new_optimizer(), RayBatches(scene, step.progress, 0, 16)

    return new


def stops_after_each(step, optimizer, loader, count):
    seen = []
    for _ in range(count):
        step(loader.at(0, step.progress.rays_seen), optimizer)
        seen.append(step.correction.stops.detach().clone())
    return seen


def test_a_run_solves_after_equal_parts_and_holds_the_stops_in_between(planted, new_step):
    scene, stops = planted
    step, optimizer, loader = new_step()
    seen = stops_after_each(step, optimizer, loader, 9)
    changed = [not torch.equal(before, after) for before, after in pairwise(seen)]
    assert changed == [True, True, True, False, False, True, False, False]
    assert step.model.training
    found = seen[-1][list(scene.splits["train"])]
    assert float(torch.corrcoef(torch.stack([found[:, 0], stops[:, 0]]))[0, 1]) > 0.99
    assert float(found.mean(dim=0).abs().max()) < 0.02
    step.restart(optimizer)
    assert (int(step.correction.solved), bool(step.correction.held), step.correction.is_held) == (0, False, False)


@pytest.mark.parametrize(("size", "taken"), [(0.5 * FAR, False), (2.0 * FAR, True)])
def test_a_solution_that_is_near_leaves_the_stops_to_gradients(size, taken):
    scene = ball_scene(VIEWS, SIZE)
    correction, trained = Exposure(), list(scene.splits["train"])
    correction.fit_to(scene)
    goal = torch.randn(VIEWS, 1, generator=torch.Generator().manual_seed(1))
    goal -= goal[trained].mean()
    goal *= size / goal[trained].square().mean().sqrt()
    pairs = made_pairs(goal.expand(-1, 3))[0]
    with torch.no_grad():
        correction._solve(pairs[(pairs.view < len(trained)).all(dim=1)])
    torch.testing.assert_close(correction.stops[trained, :1], taken * goal[trained], atol=2e-3, rtol=0)
    assert correction.is_held == bool(correction.held) == taken
    assert (correction.penalty() is None) == taken


def test_a_resumed_run_solves_when_one_that_never_stopped_would(new_step):
    whole, optimizer, loader = new_step()
    seen = stops_after_each(whole, optimizer, loader, 9)
    first, optimizer, loader = new_step()
    stops_after_each(first, optimizer, loader, 5)
    second, later, loader = new_step()
    second.model.load_state_dict(first.model.state_dict())
    second.correction.load_state_dict(first.correction.state_dict())
    second.progress.take_up(first.progress)
    later.load_state_dict(optimizer.state_dict())
    for ours, theirs in zip(stops_after_each(second, later, loader, 4), seen[5:], strict=True):
        assert torch.equal(ours, theirs)

import math
from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene, some_rays

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.randomness import batch_random, fold
from nerf_lightning.nerf.rendering.sample_points import ragged_points
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler


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
        sampler.update(density_fn, step, fold(0, 0, step))
    return sampler


def test_the_grid_finds_what_is_there_and_forgets_what_is_not():
    sampler = learn(a_sampler(), ball_density())
    centers, _ = sampler.grid.cell_centers(0)
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
        sampler.update(ball_density(radius=0.6), step, fold(0, 0, step))
    assert int(sampler.grid.cells.sum()) > 5 * before


def test_nothing_is_given_up_before_its_time():
    """Dark content on a black background: its density grows late, and must not be pruned first."""
    sampler = a_sampler(prune_after=100)
    for step in (16, 32, 96):
        sampler.update(ball_density(density=0.0), step, step)
    assert bool(sampler.grid.cells.all())
    sampler.update(ball_density(), 112, 112)
    assert not bool(sampler.grid.cells.all())


def test_a_density_that_is_the_same_everywhere_prunes_nothing():
    sampler = a_sampler()
    sampler.update(lambda positions: torch.full(positions.shape[:-1], 0.3), 16, 5)
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


def test_a_box_that_no_camera_sees_is_said_by_name():
    scene = opaque_ball()
    with pytest.raises(InputError, match=r"box of the scene ball.*no camera sees it.*scene\.aabb_half"):
        a_sampler(replace(scene, aabb=scene.aabb + 500.0))


def test_cameras_inside_the_box_are_said_by_name(caplog):
    scene = opaque_ball()
    a_sampler(replace(scene, aabb=5 * scene.aabb))
    assert "3 of 3 training cameras stand inside the box of the scene ball" in caplog.text
    caplog.clear()
    a_sampler(scene)
    assert caplog.text == ""


def contracted_ball():
    scene = opaque_ball()
    far = torch.full_like(scene.far, 16.0)
    return replace(scene, space="contracted", aabb=scene.aabb * 3**-0.5, near=0.003 * far, far=far)


def sizes(sampler):
    return {name: tuple(getattr(sampler.grid, name).shape) for name in ("density", "possible", "cells", "blocks")}


@pytest.mark.parametrize(
    ("settings", "cascades", "side", "cone_angle"),
    [
        ({}, 6, 8, 1 / 256),
        ({"num_cascades": 2}, 2, 16, 1 / 256),
        ({"cone_angle": 0.0}, 6, 8, 0.0),
        ({"resolution": 20}, 6, 8, 1 / 256),
    ],
)
def test_contracted_space_wants_more_and_coarser_boxes_unless_told(settings, cascades, side, cone_angle):
    sampler = a_sampler(contracted_ball(), **settings)
    grid = (cascades, side, side, side)
    assert sizes(sampler) == dict.fromkeys(("density", "possible", "cells"), grid) | {
        "blocks": (cascades, side // 4, side // 4, side // 4)
    }
    assert sampler.cone_angle == cone_angle
    steps = sampler.lattice.diff()
    assert (float(steps[-1]) > 1.5 * float(steps[0])) == (cone_angle > 0)


def test_in_normalised_device_coordinates_every_cell_is_possible():
    """Cells are not where the cameras see them: a box behind all cameras must not be carved away."""
    scene = opaque_ball()
    sampler = a_sampler(replace(scene, space="ndc", aabb=scene.aabb + 500.0))
    assert bool(sampler.grid.possible.all())


@pytest.mark.parametrize("placed", [None, opaque_ball(), contracted_ball()], ids=["new", "bounded", "contracted"])
@pytest.mark.parametrize("saved", [opaque_ball(), contracted_ball()], ids=["from_bounded", "from_contracted"])
def test_the_grid_takes_the_size_of_the_state_that_is_read(saved, placed):
    one = learn(a_sampler(saved), ball_density())
    other = OccupancySampler(resolution=16, num_steps=64)
    if placed is not None:
        other.fit_to(placed)
    other.load_state_dict(one.state_dict())
    assert sizes(other) == sizes(one)
    assert (other.grid.num_cascades, other.cone_angle) == (one.grid.num_cascades, one.cone_angle)
    assert torch.equal(other.grid.cells, one.grid.cells)
    assert torch.equal(other.lattice, one.lattice)
    rays = some_rays(20)
    found, expected = (each(rays, None) for each in (other, one))
    assert torch.equal(found.starts, expected.starts)
    learn(other, ball_density())


def test_cascades_cover_what_lies_far_out():
    sampler = a_sampler(contracted_ball())
    rays = some_rays(40)
    rays = replace(rays, near=torch.full((40,), 0.05), far=torch.full((40,), 16.0))
    samples = sampler(rays, None)
    assert float(samples.ends.max()) > 14.0
    assert float(ragged_points(rays, samples, None).positions.abs().max()) > 8.0
    # Intervals grow with the distance.
    far, near = samples.starts > 10.0, samples.starts < 2.0
    assert float(samples.deltas[far].mean()) > 1.4 * float(samples.deltas[near].min())


def test_a_learnt_shell_beyond_the_first_box_is_kept_and_the_rest_given_up():
    sampler = a_sampler(contracted_ball())
    learn(sampler, lambda positions: 50.0 * ((positions.norm(dim=-1) - 5.0).abs() < 1.0).float())
    cascade, x, y, z = sampler.grid.cells.nonzero().unbind(dim=-1)
    side, half = sampler.grid.resolution, 3**-0.5 * 2.0**cascade
    center = (2 * (torch.stack([x, y, z], dim=-1) + 0.5) / side - 1) * half[:, None]
    reach = 3**0.5 * half / side
    assert bool(((center.norm(dim=-1) - 5.0).abs() <= 1.0 + reach).all())
    assert {4, 5} <= set(cascade.tolist())


def test_the_centre_of_a_cell_is_the_middle_of_its_positions():
    """Bit for bit: carving asks about the centres, training about points in the same cells."""
    sampler = OccupancySampler(resolution=12, num_cascades=3)
    sampler.grid.aabb.copy_(torch.tensor([[-1.1, -0.7, -0.3], [0.9, 1.7, 1.1]]))
    for cascade in range(3):
        number = torch.arange(12**3) + cascade * 12**3
        centers, half_diagonal = sampler.grid.cell_centers(cascade)
        assert torch.equal(centers, sampler.grid.positions(number, torch.full((1, 3), 0.5)))
        assert half_diagonal == pytest.approx(2**cascade * math.hypot(2.0, 2.4, 1.4) / 24)

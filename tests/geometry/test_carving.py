from dataclasses import replace

from scenes import BALL_RADIUS, ball_scene

from nerf_lightning.geometry.carving import possible_cells
from nerf_lightning.samplers.occupancy import OccupancySampler


def cells(scene, resolution=24):
    sampler = OccupancySampler(resolution=resolution)
    sampler.aabb.copy_(scene.aabb)
    return sampler._cell_centers(0)


def test_what_the_alpha_shows_empty_is_carved_and_what_is_there_is_kept():
    scene = ball_scene(num_views=24, size=40)
    centers, half_diagonal = cells(scene)
    possible = possible_cells(scene, centers, half_diagonal)
    distance = centers.norm(dim=-1)
    assert bool(possible[distance < BALL_RADIUS].all())
    assert float(possible[distance > 1.6 * BALL_RADIUS].float().mean()) < 0.35
    assert 0.2 < float(possible.float().mean()) < 0.8


def test_without_alpha_nothing_is_carved():
    scene = ball_scene(num_views=8, size=24)
    rgba = scene.pixels.rgba.clone()
    rgba[:, 3] = 255
    opaque = replace(scene, pixels=replace(scene.pixels, rgba=rgba))
    assert bool(possible_cells(opaque, *cells(opaque)).all())


def test_cells_that_no_training_view_sees_are_left_out():
    scene = ball_scene(num_views=2, size=24)
    centers, half_diagonal = cells(scene)
    behind = centers + 2.5 * scene.cameras.c2w[0, :, 3]
    assert not bool(possible_cells(scene, behind, half_diagonal).any())

"""Baking: what is dense and seen, as bytes; marched through, they look like the model."""

from dataclasses import replace

import numpy as np
import psutil
import pytest
import torch
from support.baked_ball import RADIUS, all_around, baked_ball, deserialized, quiet, record_of, shiny_model
from support.known_fields import ball
from support.running import refused

from nerf_lightning.export.baking import baked_field
from nerf_lightning.export.baking.bake import bake
from nerf_lightning.export.baking.baked_field import described, serialized, tiles_of, to_bytes_of_density
from nerf_lightning.export.baking.contraction import Contraction
from nerf_lightning.export.baking.cost import measured_cost
from nerf_lightning.export.baking.density import depths_of_voxels
from nerf_lightning.export.baking.marcher import Marcher
from nerf_lightning.export.baking.seen_colors import sharpened
from nerf_lightning.nerf.geometry.boxes import center_and_half
from nerf_lightning.nerf.geometry.ndc import ndc_points
from nerf_lightning.nerf.types.rays import RayBundle


def cost_of(baked, model=None, scene=None):
    scene = scene or all_around()
    return measured_cost(Marcher(baked), model or shiny_model(), record_of(scene), scene, 2, 1 << 16, quiet)


def coloured_places(baked):
    at = np.argwhere(baked.colored)
    block = np.stack(np.unravel_index(baked.blocks[at[:, 0]], baked.shape), axis=1)
    return np.array(baked.lower) + baked.spacing * (8 * block + at[:, 1:])


@pytest.fixture(scope="module")
def baked():
    return baked_ball()


def test_the_bytes_look_like_the_model(baked):
    cost = cost_of(baked)
    assert cost.page_to_model > 37
    # The photographs show another ball.
    assert cost.page == pytest.approx(cost.model, abs=0.5)
    assert 1 < cost.num_colors <= cost.num_densities < 100


def test_colours_of_degree_one_follow_the_direction_that_one_constant_cannot(baked):
    assert cost_of(baked_ball(harmonics=1)).page_to_model < cost_of(baked).page_to_model - 3
    assert cost_of(baked_ball(harmonics=9)).page_to_model > cost_of(baked).page_to_model - 0.5


def test_what_is_marched_through_has_the_opacity_and_the_depth_of_the_solid():
    sigma = 20.0
    model = shiny_model(ball(RADIUS), inside=sigma)
    marcher = Marcher(baked_ball(96, 1, model))
    ahead = torch.tensor([[-1.0, 0.0, 0.0]]).expand(3, 3)
    origins = torch.tensor([[3.0, 0.0, 0.0], [3.0, 0.4, 0.0], [3.0, 0.9, 0.0]])
    near, far = torch.zeros(3), torch.full((3,), 9.0)
    marched = marcher.render(RayBundle(origins, ahead, near, far, ahead))
    half = (RADIUS**2 - torch.tensor([0.0, 0.4, 0.9]).square()).clamp(min=0).sqrt()
    torch.testing.assert_close(marched.opacity, 1 - torch.exp(-2 * sigma * half), atol=0.02, rtol=0)
    # Of constant density sigma over a length L: 1 / sigma - L exp(-sigma L) / (1 - exp(-sigma L)) into the solid.
    length = 2 * half[:2]
    inside = 1 / sigma - length * torch.exp(-sigma * length) / (1 - torch.exp(-sigma * length))
    torch.testing.assert_close(marched.depth[:2], 3 - half[:2] + inside, atol=0.05, rtol=0)
    assert marched.depth[2] == 0


def test_a_step_of_any_length_takes_its_own_share(baked, monkeypatch):
    once = cost_of(baked)
    monkeypatch.setattr("nerf_lightning.export.baking.marcher.STEP", 0.25)
    again = cost_of(baked)
    assert again.page_to_model == pytest.approx(once.page_to_model, abs=2.0)
    assert again.num_densities > 1.6 * once.num_densities


def test_only_what_is_seen_is_kept():
    def shell_and_core(positions):
        distance = positions.norm(dim=-1)
        return torch.minimum(torch.maximum(distance - 0.7, 0.6 - distance), distance - 0.3)

    baked = baked_ball(64, 1, shiny_model(shell_and_core, inside=400.0))
    distance = np.linalg.norm(coloured_places(baked), axis=1)
    assert 0.5 < distance.min() < distance.max() < 0.82


def test_bytes_of_density_are_exponents_and_a_tile_borders_on_the_first_values_of_the_next_blocks():
    optical, least = 2.0 ** np.linspace(-6, 3.5, 50), baked_field.LEAST_EXPONENT
    found = 2.0 ** (least + baked_field.EXPONENT_STEP * to_bytes_of_density(optical)) - 2.0**least
    np.testing.assert_allclose(found, optical, rtol=0.04)
    assert to_bytes_of_density(np.zeros(1))[0] == 0
    index = np.full((2, 2, 1), -1, np.int32)
    index[0, 0, 0], index[1, 1, 0] = 0, 1
    values = np.random.default_rng(0).integers(1, 255, (2, 8, 8, 8)).astype(np.uint8)
    tiles = tiles_of(values, index, empty=7)
    np.testing.assert_array_equal(tiles[:, :8, :8, :8], values)
    np.testing.assert_array_equal(tiles[0, 8, 8, :8], values[1, 0, 0])
    assert (tiles[0, 8, :8] == 7).all()
    assert (tiles[1, 8] == 7).all()


@pytest.mark.parametrize("given", [{}, {"contraction": Contraction((1.0, -2.0, 0.5), 3.0, 0.1), "closed": True}])
def test_what_is_packed_comes_back(baked, given):
    baked = replace(baked, **given)
    again = deserialized(described(baked), serialized(baked))
    for name, value in vars(baked).items():
        np.testing.assert_array_equal(getattr(again, name), value)
    assert serialized(baked) == serialized(again)


def test_normalised_device_coordinates_are_baked_as_they_are():
    scene = all_around()
    c2w = torch.eye(4)[:3].repeat(6, 1, 1)
    c2w[:, 0, 3] = torch.linspace(-0.2, 0.2, 6)
    cameras = replace(scene.cameras, c2w=c2w, ndc=torch.full((6, 2), 3.2))
    none = torch.zeros(6)
    scene = replace(scene, cameras=cameras, space="ndc", near=none, far=none + 2.0)
    middle = ndc_points(torch.tensor([[0.1, 0.0, -2.0]]), torch.tensor([3.2, 3.2]))[0]
    model = shiny_model(lambda positions: 0.2 * ball(0.3, middle.tolist())(positions))
    center = center_and_half(scene.aabb)[0]
    assert (center - middle).norm() < 0.8
    baked = baked_ball(48, 4, model, record_of(scene))
    assert cost_of(baked, model, scene).page_to_model > 32


def test_a_voxel_is_as_deep_as_the_outermost_cameras_are_off_by_one_pixel():
    scene, x, a = all_around(), 0.3, 3.2
    c2w = torch.eye(4)[:3].repeat(6, 1, 1)
    c2w[:, 0, 3] = torch.tensor([-x, 0.0, 0.0, 0.0, 0.0, x])
    cameras = replace(scene.cameras, c2w=c2w, ndc=torch.full((6, 2), a))
    right, up, deep = depths_of_voxels(record_of(replace(scene, cameras=cameras, space="ndc"))).tolist()
    assert right == up == 1.0
    # Two places that are so far apart in depth, seen from the middle at the same place, as the outer camera sees them.
    z = torch.tensor([-2.0, 2.0 / (2.0 / -2.0 - 0.01 * deep)])
    assert (2.0 / z).diff().item() == pytest.approx(-0.01 * deep, rel=1e-4)
    seen = -a * (torch.zeros(2) - x) / z
    assert seen.diff().abs().item() == pytest.approx(0.01, rel=1e-4)


def test_colours_differ_more_from_their_neighbours():
    voxels = np.argwhere(np.ones((3, 3, 3), bool)).astype(np.int32)
    fitted = torch.full((27, 4, 3), 0.25)
    torch.testing.assert_close(sharpened(fitted, voxels, (3, 3, 3)), fitted)
    fitted[13] = 0.75  # in the middle
    found = sharpened(fitted, voxels, (3, 3, 3))
    torch.testing.assert_close(found[13], torch.full((4, 3), 1.0))
    torch.testing.assert_close(found[0], fitted[0])
    torch.testing.assert_close(found[12], torch.full((4, 3), 0.25 - 0.5 * 0.5 / 5))  # beside it, with five neighbors
    alone = sharpened(fitted[:1], voxels[:1], (3, 3, 3))
    torch.testing.assert_close(alone, fitted[:1])


def test_refusals(monkeypatch):
    record = record_of(all_around())
    empty = shiny_model(inside=0.0)
    refused(bake, empty, record, 32, 1, 4096, quiet, parts=("There is nothing to export", "ball", "Train longer"))
    away = record.cameras.c2w.clone()
    away[:, :, :3] *= torch.tensor([-1.0, 1.0, -1.0])  # all turn their backs on it
    alone = replace(record, cameras=replace(record.cameras, c2w=away))
    refused(bake, shiny_model(), alone, 32, 1, 4096, quiet, parts=("Nothing of ball is seen", "poses"))
    monkeypatch.setattr(psutil, "virtual_memory", lambda: type("Memory", (), {"available": 1e9}))
    parts = ("what.resolution=1024 makes a grid", "GB", "would fit")
    refused(bake, shiny_model(), record, 1024, 1, 4096, quiet, parts=parts)

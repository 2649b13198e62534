"""Carving: what it keeps, and the compiled twin against its reference."""

import math
from dataclasses import replace

import pytest
import torch
from support.scenes import BALL_RADIUS, LENSES, ball_scene
from support.wrong_cameras import with_noise

from nerf_lightning.nerf.geometry.poses import rotation_from_vector
from nerf_lightning.nerf.kernels.carving import cpu as carving_cpu
from nerf_lightning.nerf.kernels.carving import reference as carving_reference
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler
from nerf_lightning.nerf.samplers.space_carving import possible_cells


def cells(scene, resolution=24):
    sampler = OccupancySampler(resolution=resolution)
    sampler.grid.aabb.copy_(scene.aabb)
    return sampler.grid.cell_centers()


@pytest.mark.parametrize(("model", "lens"), [("pinhole", (0.0,) * 6), *LENSES])
def test_what_the_alpha_shows_empty_is_carved_and_what_is_there_is_kept(model, lens):
    """The fault: a pinhole's places in a photograph that a lens has bent."""
    scene = ball_scene(num_views=24, size=40, lens=lens, lens_model=model)
    centers, half_diagonal = cells(scene)
    possible = possible_cells(scene, centers, half_diagonal)
    distance = centers.norm(dim=-1)
    assert bool(possible[distance < BALL_RADIUS].all())
    assert float(possible[distance > 1.6 * BALL_RADIUS].float().mean()) < 0.35
    assert float(possible.float().mean()) > 0.2


def test_without_alpha_nothing_is_carved_and_cells_that_no_training_view_sees_are_left_out():
    scene = ball_scene(num_views=8, size=24)
    rgba = scene.pixels.rgba.clone()
    rgba[:, 3] = 255
    opaque = replace(scene, pixels=replace(scene.pixels, rgba=rgba, has_transparency=False))
    assert bool(possible_cells(opaque, *cells(opaque)).all())
    scene = ball_scene(num_views=2, size=24)
    centers, half_diagonal = cells(scene)
    behind = centers + 2.5 * scene.cameras.c2w[0, :, 3]
    assert not bool(possible_cells(scene, behind, half_diagonal).any())


@pytest.fixture
def a_view():
    """A view whose pose, focal lengths and principal point are numbers without any pattern, and cells all around it."""
    scene = ball_scene(num_views=3, size=40)
    cameras = replace(
        scene.cameras,
        focal=scene.cameras.focal * torch.tensor([1.0, 1.13]),
        center=scene.cameras.center + torch.tensor([1.7, -2.3]),
    )
    generator = torch.Generator().manual_seed(0)
    return cameras, 1, 2.0 * torch.randn(60_000, 3, generator=generator), generator


@pytest.mark.parametrize("half_diagonal", [0.01, 0.07, 0.5])
def test_the_compiled_twin_sees_and_carves_what_the_reference_does(a_view, half_diagonal):
    cameras, view, centers, generator = a_view
    drawn = torch.rand(centers.shape[0], generator=generator)
    seen, carved = [], []
    matter = torch.zeros(40, 40, dtype=torch.bool)
    matter[8:19, 20:33] = True
    for kernel in (carving_cpu, carving_reference):
        seen.append(drawn < 0.1)
        carved.append(drawn < 0.9)
        kernel.add_seen(seen[-1], cameras, view, centers, half_diagonal)
        kernel.carve(carved[-1], cameras, view, centers, half_diagonal, matter)
    assert 0.2 < float(seen[1].float().mean()) < 0.9
    assert torch.equal(*seen)
    # The widest discs leave no pixel of these free of matter that is sure to be it.
    assert torch.equal(carved[1], drawn < 0.9) == (half_diagonal == 0.5)
    assert torch.equal(*carved)


def test_cameras_that_are_learnt_carve_with_a_margin():
    """From places that are wrong by a degree, too, nothing of the content; two that are far off carve nothing alone."""
    scene = replace(ball_scene(num_views=48, size=80), refined=True)
    centers, half_diagonal = cells(scene, resolution=48)
    inside = centers.norm(dim=-1) < BALL_RADIUS + half_diagonal
    turned = scene.cameras.c2w.clone()
    turned[:, :, :3] = turned[:, :, :3] @ rotation_from_vector(torch.tensor([0.0, math.radians(0.9), 0.0]))
    all_alike = replace(scene, cameras=replace(scene.cameras, c2w=turned))
    noisy, two = with_noise(scene, degrees=1.0, share=0.01), with_noise(scene, 30.0, 0.0, views=[3, 9])
    for wrong in (all_alike, noisy, two):
        possible = possible_cells(wrong, centers, half_diagonal)
        assert bool(possible[inside].all())
        assert float((~possible).float().mean()) > 0.05
        # As if the poses were right, they would have carved into it.
        assert not bool(possible_cells(replace(wrong, refined=False), centers, half_diagonal)[inside].all())

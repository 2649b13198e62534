"""Where points of rays appear in other photographs: there where `project` has them."""

import pytest
import torch
from support.looking import rays_of_views
from support.scenes import LENSES, ball_scene

from nerf_lightning.nerf.geometry.cameras import camera_coordinates, project
from nerf_lightning.nerf.models.view_transformer.projection import project_samples, seen_cosines

PINHOLE = ("pinhole", (0.0,) * 6)
PANORAMA = ("equirectangular", (0.0,) * 6)


def projected(lens_model, lens, **changes):
    scene = ball_scene(8, 64, lens=lens, lens_model=lens_model)
    rays = rays_of_views(scene, [0, 3], every=97)
    count = len(rays.near)
    places = torch.stack([torch.arange(count) % 8, torch.arange(count) * 3 % 8], dim=1)
    t = torch.linspace(0.1, 9.0, 7).expand(count, 7)
    found = project_samples(scene.cameras, seen_cosines(scene.cameras), places, rays, t)
    return scene, rays, places, t, found


@pytest.mark.parametrize(("lens_model", "lens"), [PINHOLE, PANORAMA, *LENSES])
def test_it_agrees_with_the_projection_of_points(lens_model, lens):
    scene, rays, places, t, found = projected(lens_model, lens)
    exact = scene.cameras.map(lambda each: each.double() if each.is_floating_point() else each)
    points = rays.origins[:, None].double() + t[..., None].double() * rays.directions[:, None].double()
    assert found.visible.float().mean() > 0.05
    for ray in range(len(t)):
        for source, view in enumerate(places[ray].tolist()):
            expected, seen = project(exact, view, points[ray]), found.visible[ray, :, source]
            torch.testing.assert_close(found.at[ray, seen, source].double(), expected[seen], atol=1e-4, rtol=0)
            inside = ((expected >= 1) & (expected <= 63)).all(dim=-1)
            if lens_model == "pinhole":
                inside &= camera_coordinates(exact, view, points[ray])[:, 2] < -0.1
                assert torch.equal(seen | ~inside, torch.ones_like(seen))


def test_what_lies_behind_or_outside_is_not_visible_and_has_a_place_that_harms_nothing():
    scene, rays, places, t, found = projected(*PINHOLE)
    points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
    behind = torch.stack(
        [
            torch.stack([camera_coordinates(scene.cameras, int(v), points[r])[:, 2] > 0 for v in places[r]], dim=-1)
            for r in range(len(t))
        ]
    )
    assert behind.any()
    assert not (behind & found.visible).any()
    assert torch.equal(found.at[~found.visible], torch.zeros_like(found.at[~found.visible]))


def test_a_lens_that_folds_back_shows_nothing_twice():
    """Far outside of the picture the polynomial of this lens returns into it."""
    model, lens = "radial_tangential", (-0.5, 0.0, 0.0, 0.0, 0.0, 0.0)
    scene, rays, places, t, found = projected(model, lens)
    points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
    widest = 0.0
    for ray in range(len(t)):
        for source, view in enumerate(places[ray].tolist()):
            local = camera_coordinates(scene.cameras, view, points[ray][found.visible[ray, :, source]])
            widest = max([widest, *torch.atan2(local[:, :2].norm(dim=-1), -local[:, 2]).tolist()])
    # In radians: the picture's corners lie at 0.46, and the lens folds back at 0.68.
    assert 0.3 < widest < 0.6


def test_the_difference_of_directions_is_zero_from_the_ray_itself():
    scene = ball_scene(4, 16)
    rays = rays_of_views(scene, [2], every=11)
    places = torch.full((len(rays.near), 1), 2)
    t = torch.linspace(1.0, 5.0, 3).expand(len(places), 3)
    found = project_samples(scene.cameras, seen_cosines(scene.cameras), places, rays, t)
    torch.testing.assert_close(found.turned[..., :3], torch.zeros_like(found.turned[..., :3]), atol=1e-5, rtol=0)
    torch.testing.assert_close(found.turned[..., 3], torch.ones_like(found.turned[..., 3]))

from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import (
    all_pixels,
    pinhole_cameras,
    project,
    rays_through_pixels,
    resized,
    seen_at,
)
from nerf_lightning.nerf.geometry.photographs import photographs_of
from nerf_lightning.nerf.geometry.poses import is_rigid, look_at

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


@pytest.fixture
def cameras():
    eyes = torch.tensor([[4.0, 0.0, 1.0], [0.0, -3.0, 2.0]], dtype=torch.float64)
    return pinhole_cameras(look_at(eyes, torch.zeros_like(eyes), UP), 30.0, 24, 16)


def rays_of(cameras, view):
    views = cameras.c2w.shape[0]
    return rays_through_pixels(cameras, all_pixels(cameras, view), torch.zeros(views), torch.ones(views))


def test_projecting_a_point_on_a_ray_gives_the_pixels_centre(cameras):
    """The fault: rays through the corners of pixels."""
    for view in range(2):
        rays = rays_of(cameras, view)
        pixels = project(cameras, view, rays.origins + 2.5 * rays.directions)
        index = all_pixels(cameras, view)
        torch.testing.assert_close(pixels, torch.stack([index.x, index.y], -1) + 0.5, check_dtype=False)


def test_points_are_seen_at_their_pixels_and_beside_or_behind_the_picture_nowhere(cameras):
    wider = pinhole_cameras(cameras.c2w, 30.0, 48, 32)  # 12 more columns and 8 more rows on each side
    for view in range(2):
        rays, index = rays_of(wider, view), all_pixels(wider, view)
        x, y = (index.x - 12).flatten(), (index.y - 8).flatten()
        shown = (x >= 0) & (x < 24) & (y >= 0) & (y < 16)
        for distance in (2.5, -2.5):
            points = (rays.origins + distance * rays.directions).flatten(0, 1)
            inside, column, row = seen_at(cameras, view, points)
            expected = shown & (distance > 0)
            assert torch.equal(inside, expected)
            assert torch.equal(torch.stack([column, row]), torch.stack([x, y]) * expected)


def test_a_camera_looks_along_minus_z_with_x_right_and_row_0_on_top():
    camera = pinhole_cameras(torch.eye(4, dtype=torch.float64)[None, :3], 10.0, 3, 3)
    directions = rays_of(camera, 0).directions
    torch.testing.assert_close(directions[1, 1], torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64))
    assert float(directions[1, 2, 0]) > 0  # right column looks right
    assert float(directions[0, 1, 1]) > 0  # top row looks up


def test_the_focal_length_follows_the_size_of_the_picture(cameras):
    """The fault: half the picture with the whole focal length. A point must appear at half the coordinates."""
    half = resized(cameras, cameras.width // 2, cameras.height // 2)
    point = torch.tensor([[0.3, -0.2, 0.1]], dtype=torch.float64)
    torch.testing.assert_close(project(half, 0, point), project(cameras, 0, point) / 2)
    assert float(half.focal[0, 0]) == 15.0


def test_look_at_is_rigid_and_looks_at_the_target_and_mirrors_shears_and_nan_are_not(cameras):
    assert bool(is_rigid(cameras.c2w).all())
    middle = project(cameras, 0, torch.zeros(1, 3, dtype=torch.float64))
    torch.testing.assert_close(middle, torch.tensor([[12.0, 8.0]], dtype=torch.float64))
    good = torch.eye(4)[None, :3]
    mirror, shear, nan = good.clone(), good.clone(), good.clone()
    mirror[0, 0, 0] = -1.0
    shear[0, 0, 1] = 0.2
    nan[0, 1, 3] = float("nan")
    assert is_rigid(torch.cat([good, mirror, shear, nan])).tolist() == [True, False, False, False]


def test_they_are_the_views_that_were_asked_for():
    scene = replace(ball_scene(), capture_of=(0, 0, 0, 1, 1, 1), captures=("left", "right"))
    seen = photographs_of(scene, [4, 1, 3])
    assert seen.numbers.tolist() == [4, 1, 3]
    assert seen.capture.tolist() == [1, 0, 1]
    for place, number in enumerate([4, 1, 3]):
        assert torch.equal(seen.pixels.view(place), scene.pixels.view(number))
        assert torch.equal(seen.cameras.c2w[place], scene.cameras.c2w[number])


def test_cameras_stand_around_or_face_forward_and_normalised_device_coordinates_are_refused():
    scene = ball_scene()
    around = photographs_of(scene, range(6))
    assert around.around.tolist() == [True]
    torch.testing.assert_close(around.middle, torch.zeros(1, 3), atol=1e-4, rtol=0)
    eyes = scene.cameras.c2w.clone()
    eyes[:, :, :3] = eyes[:1, :, :3]
    ahead = photographs_of(replace(scene, cameras=replace(scene.cameras, c2w=eyes)), range(6))
    assert ahead.around.tolist() == [False]
    bent = replace(scene, cameras=replace(scene.cameras, ndc=torch.ones(6, 2)))
    with pytest.raises(InputError, match=r"scene\.space=contracted"):
        photographs_of(bent, [0, 1])

"""Rays cut to a box of the user's frame or of the scene, through the world and normalized device coordinates."""

from dataclasses import replace

import torch
from support.scenes import some_rays

from nerf_lightning.nerf.geometry.boxes import distances_in_box, to_unit_cube
from nerf_lightning.nerf.geometry.cameras import all_pixels, pinhole_cameras, rays_through_pixels
from nerf_lightning.nerf.geometry.clipping import Clip, CropBox
from nerf_lightning.nerf.geometry.ndc import share_at_distance, world_distance
from nerf_lightning.nerf.geometry.poses import rotation_from_quaternion
from nerf_lightning.nerf.geometry.world_frame import points_from_user, similarity

LOWER, UPPER = (-1.0, 0.5, 2.0), (0.5, 3.0, 2.5)


def turned():
    rotation = rotation_from_quaternion(torch.tensor([0.9, 0.1, -0.3, 0.2]))
    return similarity(rotation, torch.tensor([0.3, 1.5, 2.2]), 0.5).float()


def test_points_of_cut_rays_lie_in_the_users_box_and_others_do_not(generator):
    to_user = turned()
    rays = some_rays(400, generator)
    cut = Clip(box=CropBox.from_user(LOWER, UPPER, to_user))(rays, rays, ndc=False)
    hit = cut.far > cut.near
    assert 20 < int(hit.sum()) < 400
    for share in torch.linspace(0, 1, 40):
        t = rays.near + share * (rays.far - rays.near)
        user = (rays.origins + t[:, None] * rays.directions) @ to_user[:3, :3].mT + to_user[:3, 3]
        inside = ((user > torch.tensor(LOWER)) & (user < torch.tensor(UPPER))).all(dim=-1)
        within = (t > cut.near) & (t < cut.far)
        near_a_face = torch.minimum((t - cut.near).abs(), (t - cut.far).abs()) < 1e-4
        assert torch.equal(inside | near_a_face, within | near_a_face)


def test_a_box_holds_what_the_user_sees_in_it_and_near_replaces_the_trained_one():
    box = CropBox.from_user(LOWER, UPPER, turned())
    user = torch.tensor([[0.0, 1.0, 2.2], [0.6, 1.0, 2.2], [0.0, 1.0, 2.6]])
    assert box.holds(points_from_user(user, turned())).tolist() == [True, False, False]
    rays = some_rays(3)
    assert Clip(near=1.5)(rays, rays, ndc=False).near.tolist() == [1.5] * 3
    assert Clip(near=9.0)(rays, rays, ndc=False).far.tolist() == [9.0] * 3  # nothing is left


def test_a_box_far_from_the_users_origin_is_as_sharp():
    away = turned()
    away[:3, 3] += 1e6
    shift = torch.tensor([1e6] * 3, dtype=torch.float64)
    lower, upper = (tuple((torch.tensor(corner).double() + shift).tolist()) for corner in (LOWER, UPPER))
    here, there = CropBox.from_user(LOWER, UPPER, turned()), CropBox.from_user(lower, upper, away)
    torch.testing.assert_close(here.size, there.size)
    torch.testing.assert_close(here.corner, there.corner, atol=0.3, rtol=0)  # float32 holds 1e6 to a sixteenth


def bent_rays():
    cameras = pinhole_cameras(torch.eye(4)[:3][None], 10.0, 12, 9)
    zeros, ones = torch.zeros(1), torch.ones(1)
    straight = rays_through_pixels(cameras, all_pixels(cameras, 0), zeros, ones)
    bent = replace(cameras, ndc=torch.tensor([[10 / 6, 10 / 4.5]]))
    return rays_through_pixels(bent, all_pixels(bent, 0), zeros, ones), straight


def test_a_share_of_the_way_is_a_distance_and_back():
    _, straight = bent_rays()
    for distance in (1.5, 4.0, 40.0):
        far = torch.full_like(straight.near, distance)
        torch.testing.assert_close(world_distance(straight, share_at_distance(straight, far)), far, rtol=1e-3, atol=0)
    assert float(share_at_distance(straight, torch.full_like(straight.near, 0.5)).max()) == 0.0


def test_normalised_device_coordinates_are_cut_at_the_same_distances():
    rays, straight = bent_rays()
    box = CropBox.from_user((-9.0, -9.0, -4.0), (9.0, 9.0, -2.0), torch.eye(4))
    cut = Clip(box=box)(rays, straight, ndc=True)
    for distance, depth in ((cut.near, 2.0), (cut.far, 4.0)):
        found = world_distance(straight, distance / rays.far) * -straight.directions[..., 2]
        torch.testing.assert_close(found, torch.full_like(found, depth), rtol=1e-3, atol=0)
    near = Clip(near=3.0)(rays, straight, ndc=True)
    torch.testing.assert_close(world_distance(straight, near.near / rays.far), torch.full_like(near.near, 3.0))
    torch.testing.assert_close(near.far, rays.far)


AABB = torch.tensor([[-1.0, -0.5, -2.0], [1.0, 0.5, 0.3]])


def test_a_ray_is_in_the_box_between_entering_and_leaving_it():
    rays = some_rays(500)
    enter, leave = distances_in_box(rays, AABB)
    t = torch.linspace(2.0, 6.0, 401)
    points = rays.origins[:, None] + t[:, None] * rays.directions[:, None]
    inside = ((points > AABB[0]) & (points < AABB[1])).all(-1)
    between = (t > enter[:, None]) & (t < leave[:, None])
    close = ((t - enter[:, None]).abs() < 1e-4) | ((t - leave[:, None]).abs() < 1e-4)
    assert bool(((inside == between) | close).all())
    assert 0.1 < float((enter < leave).float().mean()) < 0.99


def test_rays_along_the_axes_are_not_lost():
    rays = some_rays(1)
    rays.origins.copy_(torch.tensor([[0.2, 0.1, 4.0]]))
    rays.directions.copy_(torch.tensor([[0.0, 0.0, -1.0]]))
    enter, leave = distances_in_box(rays, AABB)
    torch.testing.assert_close(torch.cat([enter, leave]), torch.tensor([3.7, 6.0]))


def test_the_unit_cube_has_the_boxes_corners():
    torch.testing.assert_close(to_unit_cube(AABB, AABB), torch.tensor([[0.0] * 3, [1.0] * 3]))

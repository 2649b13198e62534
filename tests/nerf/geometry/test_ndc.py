"""Normalized device coordinates: closed forms, straight lines, and the way back."""

from dataclasses import replace

import pytest
import torch

from nerf_lightning.nerf.geometry.cameras import all_pixels, pinhole_cameras, rays_through_pixels
from nerf_lightning.nerf.geometry.ndc import ndc_points, ndc_rays, world_distance
from nerf_lightning.nerf.types.rays import RayBundle

SCALE = torch.tensor([1.7, 2.3], dtype=torch.float64)


def forward_rays(count=50, seed=0):
    """Rays from around the origin that look along -z, within 45 degrees."""
    generator = torch.Generator().manual_seed(seed)
    origins = 0.4 * torch.randn(count, 3, generator=generator, dtype=torch.float64).clamp(-2, 2)
    directions = torch.rand(count, 3, generator=generator, dtype=torch.float64) * 2 - 1
    directions[:, 2] = -1.0
    return bundle(origins, directions)


def bundle(origins, directions):
    directions = directions / directions.norm(dim=-1, keepdim=True)
    zeros = torch.zeros_like(origins[..., 0])
    return RayBundle(origins, directions, zeros, zeros + 1, view_directions=directions)


def test_the_near_plane_is_minus_one_and_infinity_is_one():
    points = torch.tensor([[0.3, -0.2, -1.0], [3.0, 7.0, -1e12]], dtype=torch.float64)
    found = ndc_points(points, SCALE)
    assert found[0].tolist() == pytest.approx([0.3 * 1.7, -0.2 * 2.3, -1.0])
    assert float(found[1, 2]) == pytest.approx(1.0)


def test_the_frame_of_a_picture_is_the_cubes_side():
    # Seen from the origin, the picture's border at any depth is x = 1 or y = 1.
    depth = torch.tensor([1.0, 3.0, 90.0], dtype=torch.float64)
    border = torch.stack([depth / SCALE[0], -depth / SCALE[1], -depth], dim=-1)
    assert torch.allclose(ndc_points(border, SCALE)[:, :2], torch.tensor([[1.0, -1.0]], dtype=torch.float64))


def test_rays_begin_at_the_near_plane_and_end_at_infinity():
    found = ndc_rays(forward_rays(), SCALE)
    assert torch.allclose(found.origins[:, 2], torch.tensor(-1.0, dtype=torch.float64))
    ends = found.origins + found.far[:, None] * found.directions
    assert torch.allclose(ends[:, 2], torch.tensor(1.0, dtype=torch.float64))
    assert torch.allclose(found.directions.norm(dim=-1), torch.ones(50, dtype=torch.float64))
    assert bool((found.near == 0).all())


def test_straight_lines_stay_straight():
    rays = forward_rays()
    found = ndc_rays(rays, SCALE)
    for distance in (6.0, 10.0, 1000.0):
        points = ndc_points(rays.origins + distance * rays.directions, SCALE)
        along = ((points - found.origins) * found.directions).sum(dim=-1, keepdim=True)
        assert torch.allclose(found.origins + along * found.directions, points, atol=1e-12)
        assert bool(((along[:, 0] > 0) & (along[:, 0] < found.far)).all())


def test_rays_know_where_the_camera_looked_in_the_world():
    rays = forward_rays()
    found = ndc_rays(rays, SCALE)
    assert torch.equal(found.view_directions, rays.view_directions)
    assert not torch.allclose(found.directions, rays.directions, atol=0.05)


@pytest.mark.parametrize("distance", [2.5, 6.0, 40.0])
def test_world_distance_is_the_way_back(distance):
    rays = forward_rays()
    points = rays.origins + distance * rays.directions
    keep = points[:, 2] < -1.0
    found = ndc_rays(rays, SCALE)
    share = ((ndc_points(points, SCALE) - found.origins) * found.directions).sum(dim=-1) / found.far
    back = world_distance(rays, share)
    assert int(keep.sum()) > 10
    assert torch.allclose(back[keep], torch.full_like(back, distance)[keep], rtol=1e-9)


def test_light_from_infinity_and_rays_that_look_sideways_give_numbers():
    rays = forward_rays()
    depth = world_distance(rays, torch.ones(50, dtype=torch.float64))
    assert bool((torch.isfinite(depth) & (depth > 100)).all())
    found = ndc_rays(bundle(torch.zeros(2, 3), torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.5]])), SCALE.float())
    assert bool(torch.isfinite(found.origins).all() & torch.isfinite(found.directions).all())
    assert bool((found.origins[:, 2] == -1).all())


def test_cameras_bend_their_rays_where_they_are_told_to():
    c2w = torch.eye(4)[:3].repeat(2, 1, 1)
    c2w[1, 0, 3] = 0.25
    straight = pinhole_cameras(c2w, 10.0, 8, 6)
    scale = torch.tensor([[2.5, 10 / 3]]).repeat(2, 1)
    near, far = torch.zeros(2), torch.ones(2)
    pixels = all_pixels(straight, 1)
    bent = rays_through_pixels(replace(straight, ndc=scale), pixels, near, far)
    by_hand = ndc_rays(rays_through_pixels(straight, pixels, near, far), scale[pixels.view])
    assert torch.equal(bent.origins, by_hand.origins)
    assert torch.equal(bent.far, by_hand.far)
    # The camera at the origin sees the cube's side along its border: parallel rays.
    corner = rays_through_pixels(replace(straight, ndc=scale), all_pixels(straight, 0), near, far)
    assert bool((corner.directions[..., 2] > 0.9999).all())

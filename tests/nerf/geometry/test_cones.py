"""Pixels' cones: their size against neighboring rays, their covariance against points drawn, and maps of space."""

from dataclasses import replace

import pytest
import torch
from support.scenes import LENSES, ball_scene, some_rays

from nerf_lightning.nerf.geometry.cameras import rays_through_pixels
from nerf_lightning.nerf.geometry.cones import (
    cone_covariance,
    contracted_covariance,
    from_matrix,
    scaled_covariance,
    to_matrix,
)
from nerf_lightning.nerf.geometry.contraction import contract
from nerf_lightning.nerf.rendering.sample_points import points_along, ragged_points
from nerf_lightning.nerf.types.rays import PixelIndex, RaggedSamples, RaySamples


def one_camera(size):
    """Exact enough for differences of neighboring rays."""
    cameras = ball_scene(num_views=1, size=size).cameras
    return cameras.map(lambda each: each.double() if each.is_floating_point() else each)


def three_rays(cameras, x, y):
    """Through a pixel, its right neighbor and the one below."""
    near = torch.zeros(len(cameras.width), dtype=cameras.focal.dtype)
    return [
        rays_through_pixels(cameras, PixelIndex(torch.zeros_like(x), x + right, y + down), near, near + 1)
        for right, down in ((0, 0), (1, 0), (0, 1))
    ]


@pytest.mark.parametrize(("model", "lens"), [("pinhole", (0.0,) * 6), *LENSES, ("equirectangular", (0.0,) * 6)])
def test_a_pixel_is_as_large_as_neighbouring_rays_are_apart(model, lens):
    cameras = one_camera(640)
    focal = torch.tensor([[640 / 6.3, 700 / 6.3]] if model == "equirectangular" else [[640.0, 700.0]]).double()
    cameras = replace(cameras, lens_model=model, lens=torch.tensor([lens]).double(), focal=focal)
    x, y = torch.tensor([5, 100, 320, 600]), torch.tensor([30, 500, 320, 100])
    here, right, below = three_rays(cameras, x, y)
    across, down = right.directions - here.directions, below.directions - here.directions
    side = torch.linalg.cross(across, down).norm(dim=-1).sqrt()
    assert not here.pixel_side[:, 0].any()
    torch.testing.assert_close(here.pixel_side[:, 1], side, rtol=0.03, atol=0)


def test_in_normalised_device_coordinates_a_pixel_is_as_large_at_every_depth():
    cameras = one_camera(40)
    cameras = replace(cameras, c2w=torch.eye(4).double()[None, :3], ndc=cameras.focal / 20.0)
    here, *_ = three = three_rays(cameras, torch.tensor([3, 20]), torch.tensor([35, 20]))
    for share in (0.0, 0.6, 1.0):
        at, beside, under = (rays.origins + share * rays.far[:, None] * rays.directions for rays in three)
        side = ((beside - at).norm(dim=-1) * (under - at).norm(dim=-1)).sqrt()
        torch.testing.assert_close(here.pixel_side, torch.stack([side, torch.zeros(2).double()], dim=-1))


def test_a_covariance_is_that_of_points_drawn_from_what_a_sample_stands_for():
    torch.manual_seed(0)
    axes = torch.linalg.qr(torch.randn(3, 3))[0]
    lengths = torch.tensor([0.9, 0.2, 0.2])  # along the ray, and twice across
    drawn = ((torch.rand(200_000, 3) - 0.5) * lengths) @ axes.T
    found = to_matrix(cone_covariance(axes[:, 0], torch.tensor(0.9), torch.tensor(0.2)))
    torch.testing.assert_close(found, drawn.T.cov(), rtol=0.05, atol=2e-4)
    assert torch.equal(from_matrix(found), cone_covariance(axes[:, 0], torch.tensor(0.9), torch.tensor(0.2)))


def test_covariances_follow_maps_of_space_by_their_jacobian():
    torch.manual_seed(1)
    positions = torch.tensor([[0.2, -0.3, 0.1], [0.0, 0.0, 0.0], [1.5, -0.4, 2.0], [-30.0, 2.0, 9.0]]).double()
    halves = torch.randn(4, 3, 3).double()
    covariance = from_matrix(halves @ halves.mT)
    jacobian = torch.stack([torch.autograd.functional.jacobian(contract, position) for position in positions])
    expected = jacobian @ to_matrix(covariance) @ jacobian.mT
    torch.testing.assert_close(to_matrix(contracted_covariance(covariance, positions)), expected)
    scale = torch.tensor([2.0, 0.5, -3.0]).double()
    stretched = torch.diag(scale) @ to_matrix(covariance) @ torch.diag(scale)
    torch.testing.assert_close(to_matrix(scaled_covariance(covariance, scale)), stretched)


def test_both_layouts_of_samples_have_the_same_cones_and_only_where_they_are_asked_for():
    rays, edges = replace(some_rays(5), pixel_side=torch.rand(5, 2)), torch.linspace(2, 6, 4).expand(5, 4)
    dense, each = RaySamples(edges), torch.arange(5).repeat_interleave(3)
    starts, ends = dense.starts.flatten(), dense.ends.flatten()
    packed = RaggedSamples(each, starts, ends, torch.arange(6) * 3, torch.tensor(15))
    along = points_along(rays, dense, None, cones=True)
    torch.testing.assert_close(ragged_points(rays, packed, None, cones=True).covariance, along.covariance.flatten(0, 1))
    side = rays.pixel_side[2, 0] + rays.pixel_side[2, 1] * dense.midpoints[2, 1]
    expected = cone_covariance(rays.directions[2], dense.deltas[2, 1], side)
    torch.testing.assert_close(along.covariance[2, 1], expected)
    assert points_along(rays, dense, None).covariance is None
    assert ragged_points(rays, packed, None).covariance is None
    nobodys = replace(rays, pixel_side=None)
    assert points_along(nobodys, dense, None, cones=True).covariance is None

"""Footprints: discs that hold all that a view sees of a sphere."""

import math
from dataclasses import replace

import pytest
import torch
from support.scenes import LENSES

from nerf_lightning.nerf.geometry.cameras import all_pixels, pinhole_cameras, rays_through_pixels
from nerf_lightning.nerf.geometry.footprints import footprint


@pytest.mark.parametrize(("model", "lens"), LENSES)
def test_a_footprint_holds_whatever_the_sphere_touches(model, lens):
    """Every pixel whose ray meets the sphere lies in its disc, also at the rim and for spheres half outside."""
    size, reach = 80, 0.15
    cameras = pinhole_cameras(torch.eye(4)[None, :3], 40.0, size, size)
    cameras = replace(cameras, lens=torch.tensor([lens]), lens_model=model)
    index = all_pixels(cameras, 0).map(torch.flatten)
    rays = rays_through_pixels(cameras, index, torch.zeros(1), torch.ones(1)).directions
    generator = torch.Generator().manual_seed(0)
    centers = torch.randn(400, 3, generator=generator) * torch.tensor([3.0, 3.0, 1.5]) - torch.tensor([0.0, 0.0, 2.0])
    x, y, radius = footprint(cameras, 0, centers, reach)
    apart_enough = centers.norm(dim=-1, keepdim=True) > 2 * reach
    along = centers @ rays.T
    met = (along > 0) & (centers.square().sum(-1, keepdim=True) - along.square() < reach**2) & apart_enough
    apart = torch.hypot(index.x + 0.5 - x[:, None], index.y + 0.5 - y[:, None])
    assert int(met.any(dim=1).sum()) > 50
    assert bool((apart <= radius[:, None])[met].all())
    true_radius = (met.sum(dim=1) / torch.pi).sqrt()
    inside = torch.maximum((x - size / 2).abs(), (y - size / 2).abs()) + true_radius < size / 2
    assert float((radius / true_radius)[inside & (true_radius > 2)].median()) < 2


def test_what_a_lens_folds_back_into_the_image_is_not_seen_there():
    """The formula of this lens shows what is twice as far off the axis as the corners in the middle of the image."""
    cameras = pinhole_cameras(torch.eye(4)[None, :3], 50.0, 40, 80)
    cameras = replace(
        cameras, lens=torch.tensor([[0.0578, -0.0805, 0.0, 0.0, 0.0, 0.0]]), lens_model="radial_tangential"
    )
    outside = torch.tensor([[2.0, 0.0, -1.0], [0.0, 1.95, -1.0], [0.0, 0.0, 3.0]])
    assert footprint(cameras, 0, outside, 0.05)[2].tolist() == [0.0, 0.0, 0.0]


def test_a_sphere_beyond_the_rim_is_seen_where_it_reaches_into_the_image():
    """The fault: its centre, beyond the fold of the lens, shown on the other side of the image."""
    cameras = pinhole_cameras(torch.eye(4)[None, :3].double(), 90.0, 80, 80)
    lens = torch.tensor([[-0.36, 0.0, 0.0, 0.0, 0.0, 0.0]]).double()
    cameras = replace(cameras, lens=lens, lens_model="radial_tangential")
    off_axis, heading = math.radians(60), math.sqrt(0.5)  # towards the lower right corner, which is 40 degrees off
    center = torch.tensor([[math.sin(off_axis) * heading, -math.sin(off_axis) * heading, -math.cos(off_axis)]])
    x, y, radius = footprint(cameras, 0, 0.5 * center.double(), 0.2)  # 24 degrees around
    assert float(x) == pytest.approx(79.5, abs=1e-3)
    assert float(y) == pytest.approx(79.5, abs=1e-3)
    assert float(radius) > 1.0


def test_without_coefficients_a_footprint_is_nearly_the_pinholes():
    cameras = pinhole_cameras(torch.eye(4)[None, :3], 20.0, 40, 40)
    centers = torch.tensor([[0.0, 0.0, -3.0], [1.0, -0.5, -4.0], [-1.5, 1.2, -2.0]])
    x, y, radius = footprint(cameras, 0, centers, 0.1)
    bent_x, bent_y, bent_radius = footprint(replace(cameras, lens_model="radial_tangential"), 0, centers, 0.1)
    torch.testing.assert_close(torch.stack([bent_x, bent_y]), torch.stack([x, y]))
    torch.testing.assert_close(bent_radius, radius, rtol=0.3, atol=0)

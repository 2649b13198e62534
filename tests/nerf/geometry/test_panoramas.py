import math
from dataclasses import replace

import pytest
import torch
from support.panoramas import near_the_bricks
from support.scenes import LENSES

from nerf_lightning.nerf.geometry.cameras import all_pixels, pinhole_cameras, project, rays_through_pixels
from nerf_lightning.nerf.geometry.footprints import footprint
from nerf_lightning.nerf.geometry.lens_checks import lens_faults
from nerf_lightning.nerf.geometry.lenses import project_plane, stretches, unproject
from nerf_lightning.nerf.geometry.panoramas import panorama_cameras

NOTHING = torch.zeros(1, 6, dtype=torch.float64)


def at_origin(cameras):
    return replace(cameras, c2w=torch.cat([cameras.c2w[..., :3], torch.zeros_like(cameras.c2w[..., 3:])], dim=-1))


def all_rays(cameras, view=0):
    bounds = torch.zeros(len(cameras.c2w)).to(cameras.c2w)
    return rays_through_pixels(cameras, all_pixels(cameras, view), bounds, bounds + 1)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 2e-4)])
def test_every_pixel_comes_back_from_its_ray_and_every_ray_from_its_pixel(dtype, tolerance):
    cameras = at_origin(panorama_cameras(near_the_bricks(1).to(dtype), 64, 33))
    index, rays = all_pixels(cameras, 0), all_rays(cameras)
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(33, 64, dtype=dtype))
    place = project(cameras, 0, 3.0 * rays.directions)
    expected = torch.stack([index.x, index.y], dim=-1) + 0.5
    torch.testing.assert_close(place, expected.to(dtype), atol=tolerance, rtol=0)
    assert not lens_faults(cameras, ["pano"])


def test_the_middle_looks_ahead_a_quarter_to_the_right_and_the_top_up():
    cameras = panorama_cameras(torch.eye(4, dtype=torch.float64)[:3][None], 4, 2)
    ahead, right, up, behind = (
        project(cameras, 0, torch.tensor(point, dtype=torch.float64)).tolist()
        for point in ((0.0, 0, -5), (7.0, 0, 0), (0.0, 2, 0), (-1e-9, 0, 1))
    )
    assert ahead == pytest.approx([2.0, 1.0])
    assert right == pytest.approx([3.0, 1.0])
    assert up[1] == pytest.approx(0.0)
    assert behind == pytest.approx([0.0, 1.0], abs=1e-6)


def test_stretches_are_those_of_finite_differences():
    angles = 0.9 * (torch.rand(50, 2, dtype=torch.float64) - 0.5) * torch.tensor([2 * math.pi, math.pi])
    directions = unproject(angles, NOTHING, "equirectangular")
    least, most = stretches(directions, NOTHING, "equirectangular").unbind(dim=-1)
    step = 1e-6
    sideways = torch.linalg.cross(
        directions, torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64).expand_as(directions)
    )
    sideways = sideways / sideways.norm(dim=-1, keepdim=True)
    upwards = torch.linalg.cross(directions, sideways)
    for along, expected in ((sideways, most), (upwards, least)):
        moved = project_plane(directions + step * along, NOTHING, "equirectangular")
        torch.testing.assert_close((moved - angles).norm(dim=-1) / step, expected, rtol=1e-4, atol=1e-4)


def test_discs_hold_the_small_spheres_that_they_stand_for():
    generator = torch.Generator().manual_seed(0)
    cameras = panorama_cameras(torch.eye(4)[:3][None], 128, 64)
    centers = 2.0 * torch.randn(400, 3, generator=generator)
    radius = 0.2
    x, y, reach = footprint(cameras, 0, centers, radius)
    on_sphere = torch.nn.functional.normalize(torch.randn(400, 60, 3, generator=generator), dim=-1)
    places = project(cameras, 0, centers[:, None] + radius * on_sphere)
    missed = (places - torch.stack([x, y], dim=-1)[:, None]).norm(dim=-1).amax(dim=1)
    # Whoever is said to lie within the picture really does.
    whole = (x - reach >= 0) & (x + reach <= 128) & (y - reach >= 0) & (y + reach <= 64) & (reach > 0)
    assert int(whole.sum()) > 150
    off_diagonal = 2**0.5  # a disc of pixels against a box of angles
    assert bool((missed[whole] <= off_diagonal * reach[whole] + 1e-3).all())
    assert bool((reach[centers.norm(dim=-1) < 2 * radius] == 0).all())


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
    """The fault: its center, beyond the fold of the lens, shown on the other side of the image."""
    cameras = pinhole_cameras(torch.eye(4)[None, :3].double(), 90.0, 80, 80)
    lens = torch.tensor([[-0.36, 0.0, 0.0, 0.0, 0.0, 0.0]]).double()
    cameras = replace(cameras, lens=lens, lens_model="radial_tangential")
    off_axis, heading = math.radians(60), math.sqrt(0.5)  # toward the lower right corner, which is 40 degrees off
    center = torch.tensor([[math.sin(off_axis) * heading, -math.sin(off_axis) * heading, -math.cos(off_axis)]])
    x, y, radius = footprint(cameras, 0, 0.5 * center.double(), 0.2)  # 24 degrees around
    assert float(x) == pytest.approx(79.5, abs=1e-3)
    assert float(y) == pytest.approx(79.5, abs=1e-3)
    assert float(radius) > 1.0

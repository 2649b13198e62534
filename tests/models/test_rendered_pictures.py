"""Whole views: what is rendered in normalised device coordinates is told in the world's units."""

from dataclasses import replace

import pytest
import torch

from nerf_lightning.fields.base import Field
from nerf_lightning.geometry.cameras import all_pixels, pinhole_cameras, rays_through_pixels
from nerf_lightning.models.levels import Level, RadianceModel
from nerf_lightning.models.pictures import render_picture
from nerf_lightning.samplers.stratified import StratifiedSampler
from nerf_lightning.types import FieldOutput


class Wall(Field):
    """Opaque behind a plane z = `place` of the space that it is asked in."""

    def __init__(self, place, behind=1.0):
        super().__init__()
        self.place_of, self.behind = place, behind
        self.anchor = torch.nn.Parameter(torch.zeros(1))

    def density(self, positions):
        return 1e5 * (self.behind * (positions[..., 2] - self.place_of) > 0).float()

    def forward(self, positions, directions, random):
        return FieldOutput(self.density(positions), torch.full_like(positions, 0.5))

    def reset_parameters(self):
        pass


@pytest.mark.parametrize("depth", [1.5, 3.0, 12.0])
def test_depth_in_normalised_device_coordinates_is_distance_in_the_world(depth):
    c2w = torch.eye(4)[:3].repeat(1, 1, 1)
    c2w[0, :, 3] = torch.tensor([0.2, -0.1, 0.3])
    straight = pinhole_cameras(c2w, 10.0, 12, 9)
    bent = replace(straight, ndc=torch.tensor([[10 / 6, 10 / 4.5]]))
    model = RadianceModel({"only": Level(StratifiedSampler(4000), Wall(1 - 2 / depth))})
    near, far = torch.zeros(1), torch.ones(1)
    picture = render_picture(model, bent, 0, near, far, "black", tile_points=100_000)
    rays = rays_through_pixels(straight, all_pixels(straight, 0), near, far)
    expected = (depth + 0.3) / -rays.directions[..., 2]
    torch.testing.assert_close(picture.depth, expected, rtol=0.01, atol=0)
    assert bool((picture.opacity > 0.999).all())


def test_where_nothing_is_the_depth_is_far_and_finite():
    bent = replace(pinhole_cameras(torch.eye(4)[:3][None], 10.0, 4, 4), ndc=torch.tensor([[5.0, 5.0]]))
    model = RadianceModel({"only": Level(StratifiedSampler(8), Wall(2.0))})
    picture = render_picture(model, bent, 0, torch.zeros(1), torch.ones(1), "black", tile_points=1000)
    assert bool((torch.isfinite(picture.depth) & (picture.depth > 100)).all())
    assert float(picture.opacity.max()) == 0.0


def test_elsewhere_depth_is_the_distance_along_the_ray():
    cameras = pinhole_cameras(torch.eye(4)[:3][None], 10.0, 4, 4)
    model = RadianceModel({"only": Level(StratifiedSampler(4000), Wall(-3.0, behind=-1.0))})
    picture = render_picture(model, cameras, 0, torch.full((1,), 1.0), torch.full((1,), 6.0), "black", 100_000)
    rays = rays_through_pixels(cameras, all_pixels(cameras, 0), torch.zeros(1), torch.ones(1))
    torch.testing.assert_close(picture.depth, 3.0 / -rays.directions[..., 2], rtol=0.01, atol=0)

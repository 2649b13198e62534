"""Whole views: what is rendered in normalised device coordinates is told in the world's units."""

from dataclasses import replace

import pytest
import torch

from nerf_lightning.nerf.fields.base import Field
from nerf_lightning.nerf.geometry.cameras import all_pixels, pinhole_cameras, rays_through_pixels
from nerf_lightning.nerf.geometry.clipping import Clip, CropBox
from nerf_lightning.nerf.models.dense_level import DenseLevel
from nerf_lightning.nerf.models.proposal_level import ProposalLevel
from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import render_picture
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler
from nerf_lightning.nerf.types.renderings import FieldOutput


class Wall(Field):
    """Opaque behind a plane z = `place` of the space that it is asked in."""

    def __init__(self, place, behind=1.0):
        super().__init__()
        self.place_of, self.behind = place, behind
        self.anchor = torch.nn.Parameter(torch.zeros(1))

    def density(self, points):
        return 1e5 * (self.behind * (points.positions[..., 2] - self.place_of) > 0).float(), None

    def forward(self, points, features=None):
        return FieldOutput(self.density(points)[0], torch.full_like(points.positions, 0.5))

    def reset_parameters(self):
        pass


@pytest.mark.parametrize("depth", [1.5, 3.0, 12.0])
def test_depth_in_normalised_device_coordinates_is_distance_in_the_world(depth):
    c2w = torch.eye(4)[:3].repeat(1, 1, 1)
    c2w[0, :, 3] = torch.tensor([0.2, -0.1, 0.3])
    straight = pinhole_cameras(c2w, 10.0, 12, 9)
    bent = replace(straight, ndc=torch.tensor([[10 / 6, 10 / 4.5]]))
    model = RadianceModel({"only": DenseLevel(StratifiedSampler(4000), Wall(1 - 2 / depth))})
    near, far = torch.zeros(1), torch.ones(1)
    picture = render_picture(model, RayGenerator(bent, near, far), 0, "black", tile_points=100_000)
    rays = rays_through_pixels(straight, all_pixels(straight, 0), near, far)
    expected = (depth + 0.3) / -rays.directions[..., 2]
    torch.testing.assert_close(picture.depth, expected, rtol=0.01, atol=0)
    assert bool((picture.opacity > 0.999).all())


def test_what_is_cut_off_in_normalised_device_coordinates_is_gone_and_depth_stays():
    bent = replace(pinhole_cameras(torch.eye(4)[:3][None], 10.0, 12, 9), ndc=torch.tensor([[10 / 6, 10 / 4.5]]))
    model = RadianceModel({"only": DenseLevel(StratifiedSampler(4000), Wall(1 - 2 / 3.0))})
    near, far = torch.zeros(1), torch.ones(1)
    for box, seen in (((-2.5, -3.5), 1.0), ((-1.5, -2.5), 0.0)):
        clip = Clip(box=CropBox.from_user((-9.0, -9.0, box[1]), (9.0, 9.0, box[0]), torch.eye(4)))
        picture = render_picture(model, RayGenerator(bent, near, far), 0, "black", 100_000, clip)
        assert picture.opacity.min() == pytest.approx(seen, abs=1e-3)
        assert picture.opacity.max() == pytest.approx(seen, abs=1e-3)
        if seen:
            assert float(picture.depth[4, 6]) == pytest.approx(3.0, rel=0.02)


def test_where_nothing_is_the_depth_is_far_and_finite():
    bent = replace(pinhole_cameras(torch.eye(4)[:3][None], 10.0, 4, 4), ndc=torch.tensor([[5.0, 5.0]]))
    model = RadianceModel({"only": DenseLevel(StratifiedSampler(8), Wall(2.0))})
    picture = render_picture(model, RayGenerator(bent, torch.zeros(1), torch.ones(1)), 0, "black", tile_points=1000)
    assert bool((torch.isfinite(picture.depth) & (picture.depth > 100)).all())
    assert float(picture.opacity.max()) == 0.0


def test_elsewhere_depth_is_the_distance_along_the_ray():
    cameras = pinhole_cameras(torch.eye(4)[:3][None], 10.0, 4, 4)
    model = RadianceModel({"only": DenseLevel(StratifiedSampler(4000), Wall(-3.0, behind=-1.0))})
    picture = render_picture(
        model, RayGenerator(cameras, torch.full((1,), 1.0), torch.full((1,), 6.0)), 0, "black", 100_000
    )
    rays = rays_through_pixels(cameras, all_pixels(cameras, 0), torch.zeros(1), torch.ones(1))
    torch.testing.assert_close(picture.depth, 3.0 / -rays.directions[..., 2], rtol=0.01, atol=0)


class Ball(Wall):
    """Opaque inside a ball of this radius around (0, 0, -4); its colour is where it is looked at from."""

    def density(self, points):
        away = points.positions - torch.tensor([0.0, 0.0, -4.0])
        return 1e5 * (away.norm(dim=-1) < self.place_of).float(), None

    def forward(self, points, features=None):
        return FieldOutput(self.density(points)[0], (0.5 + 0.5 * points.directions).expand_as(points.positions))


def looking_along(pose):
    cameras = pinhole_cameras(pose[None], 20.0, 9, 9)
    return RayGenerator(cameras, torch.full((1,), 2.0), torch.full((1,), 6.0))


def ball_picture(model, clip=None, seen_from=None):
    return render_picture(model, looking_along(torch.eye(4)[:3]), 0, "black", 100_000, clip, seen_from)


def test_outside_of_the_box_nothing_is_shown():
    model = RadianceModel({"only": DenseLevel(StratifiedSampler(2000), Ball(1.0))})
    left = Clip(box=CropBox.from_user((-2.0, -2.0, -4.5), (0.0, 2.0, -3.5), torch.eye(4)))
    picture = ball_picture(model, left)
    assert float(picture.opacity[4, 2]) == pytest.approx(1.0)
    assert float(picture.opacity[:, 5:].max()) == 0.0
    assert float(picture.rgb[:, 5:].max()) == 0.0
    assert float(picture.depth[4, 3]) == pytest.approx(3.5, abs=0.03)  # the cut, not the ball's surface at 3
    nothing = Clip(box=CropBox.from_user((5.0, 5.0, 5.0), (6.0, 6.0, 6.0), torch.eye(4)))
    assert float(ball_picture(model, nothing).opacity.max()) == 0.0


def test_rays_that_miss_the_box_are_not_rendered(monkeypatch):
    model = RadianceModel({"only": DenseLevel(StratifiedSampler(10), Ball(1.0))})
    asked = []
    monkeypatch.setattr(
        Ball, "density", lambda self, points: (asked.append(points.positions) or points.positions[..., 0], None)
    )
    ball_picture(model, Clip(box=CropBox.from_user((-2.0, -2.0, -4.5), (0.0, 2.0, -3.5), torch.eye(4))))
    assert 0 < sum(part.shape[0] for part in asked) < 60  # of 81
    assert float(torch.cat(asked)[..., 0].max()) <= 0.0


def test_a_later_near_looks_into_things():
    model = RadianceModel({"only": DenseLevel(StratifiedSampler(2000), Ball(1.0))})
    assert float(ball_picture(model).depth[4, 4]) == pytest.approx(3.0, abs=0.01)
    assert float(ball_picture(model, Clip(near=4.0)).depth[4, 4]) == pytest.approx(4.0, abs=0.01)


def test_colour_can_be_looked_up_from_elsewhere():
    model = RadianceModel({"only": DenseLevel(StratifiedSampler(100), Ball(1.0))})
    aside = torch.tensor([[0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0]])
    plain, seen = ball_picture(model), ball_picture(model, seen_from=looking_along(aside))
    torch.testing.assert_close(plain.depth, seen.depth)
    torch.testing.assert_close(plain.rgb[4, 4], torch.tensor([0.5, 0.5, 0.0]))
    torch.testing.assert_close(seen.rgb[4, 4], torch.tensor([0.0, 0.5, 0.5]))


def test_the_first_picture_of_several_levels_is_kept():
    small, large = DenseLevel(StratifiedSampler(400), Ball(0.5)), DenseLevel(StratifiedSampler(400), Ball(1.0))
    picture = ball_picture(RadianceModel({"coarse": small, "fine": large}), Clip(near=2.5))
    torch.testing.assert_close(picture.first_rgb[4, 4], picture.rgb[4, 4])
    assert float(picture.first_rgb[4, 1].max()) == 0.0
    assert float(picture.rgb[4, 1].max()) > 0.4
    assert ball_picture(RadianceModel({"only": large})).first_rgb is None
    proposal = ProposalLevel(StratifiedSampler(400), Ball(0.5))
    assert ball_picture(RadianceModel({"proposal": proposal, "fine": large})).first_rgb is None

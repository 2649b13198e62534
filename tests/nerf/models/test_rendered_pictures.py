"""Whole views, in the world's units and of several rays a pixel."""

from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene, tiny_model
from support.steps import gradients, make_step, rays_of

from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.fields.base import Field
from nerf_lightning.nerf.geometry.cameras import all_pixels, pinhole_cameras, rays_through_pixels, resized
from nerf_lightning.nerf.geometry.clipping import Clip, CropBox
from nerf_lightning.nerf.losses.proposal import ProposalLoss
from nerf_lightning.nerf.models.dense_level import DenseLevel
from nerf_lightning.nerf.models.proposal_level import ProposalLevel
from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.models.ray_generator import (
    RayGenerator,
    Subpixels,
    for_each_ray,
    mean_over_pixels,
    random_of_rays,
)
from nerf_lightning.nerf.models.render_image import render_picture
from nerf_lightning.nerf.objective import Objective
from nerf_lightning.nerf.part import StepContext, fit_parts
from nerf_lightning.nerf.randomness import batch_random, fold
from nerf_lightning.nerf.rendering.background import blend
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler
from nerf_lightning.nerf.types.renderings import FieldOutput
from nerf_lightning.training.step import TrainStep


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


class Ball(Wall):
    """Opaque inside a ball of this radius around (0, 0, -4); its color is where it is looked at from."""

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


def test_a_later_near_looks_into_things_and_colour_can_be_looked_up_from_elsewhere():
    model = RadianceModel({"only": DenseLevel(StratifiedSampler(2000), Ball(1.0))})
    assert float(ball_picture(model).depth[4, 4]) == pytest.approx(3.0, abs=0.01)
    assert float(ball_picture(model, Clip(near=4.0)).depth[4, 4]) == pytest.approx(4.0, abs=0.01)
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


def model_with(side, start=0.0, density_bias=0.5):
    torch.manual_seed(3)
    plain = tiny_model(density_bias=density_bias)
    model = RadianceModel(dict(plain.levels.items()), subpixels=side, subpixels_from=start)
    fit_parts(model, ball_scene())
    return model


@pytest.mark.parametrize("side", [2, 3])
def test_a_picture_is_the_mean_of_one_that_many_times_as_large(side):
    scene = ball_scene()
    model = model_with(side)
    enlarged = replace(scene, cameras=resized(scene.cameras, side * scene.cameras.width, side * scene.cameras.height))
    large = render_picture(model, rays_of(enlarged), 1, "white", 1 << 16)
    before = render_picture(model, rays_of(scene), 1, "white", 1 << 16)
    model.subpixels.on_step(StepContext(0.5, 0, 0))
    picture = render_picture(model, rays_of(scene), 1, "white", 1 << 16)
    for name in ("rgb", "depth", "opacity"):
        image = getattr(large, name).reshape(*getattr(large, name).shape[:2], -1).permute(2, 0, 1)
        expected = torch.nn.functional.avg_pool2d(image, side).permute(1, 2, 0).squeeze(-1)
        torch.testing.assert_close(getattr(picture, name), expected, rtol=1e-4, atol=1e-4)
    assert float((picture.rgb - before.rgb).abs().max()) > 1e-3


def test_rays_share_a_pixel_and_its_area():
    scene = ball_scene()
    subpixels = Subpixels(2)
    rays, pixels = rays_of(scene), RayBatches(scene, make_step(None).progress, 0, 5).batch_at(0, 0).pixels
    centre = rays(pixels)
    subpixels.on_step(StepContext(1.0, 0, 0))
    several = rays.of_pixels(pixels, subpixels)
    torch.testing.assert_close(several.pixel_side[::4], centre.pixel_side / 2, rtol=2e-2, atol=1e-6)
    mean = several.directions.unflatten(0, (5, 4)).mean(dim=1)
    torch.testing.assert_close(mean / mean.norm(dim=-1, keepdim=True), centre.directions, rtol=0, atol=2e-4)
    assert float((several.directions[::4] - centre.directions).norm(dim=-1).min()) > 5e-3


@pytest.mark.parametrize("background", ["white", "random"])
@pytest.mark.parametrize("tile_points", [None, 64])
def test_a_step_compares_the_mean_of_a_pixel_s_rays_with_its_photograph(tile_points, background):
    scene = ball_scene()
    model = model_with(2)
    train_step = make_step(tile_points, model, background)
    found, losses = gradients(train_step, scene)
    batch, random = RayBatches(scene, make_step(None).progress, 0, 64).batch_at(0, 0), batch_random(fold(0, 0, 0), 64)
    behind = random.uniform("background", 3) if background == "random" else torch.ones(64, 3)
    renderings = model(
        train_step.objective.rays.of_pixels(batch.pixels, model.subpixels),
        for_each_ray(behind, 4),
        random_of_rays(random, 4),
    )
    target = blend(batch.rgba, behind)
    expected = [(each.rgb.view(64, 4, 3).mean(dim=1) - target).square().mean() for each in renderings]
    by_hand = torch.autograd.grad(torch.stack(expected).sum(), list(model.parameters()))
    torch.testing.assert_close(losses, torch.stack(expected), rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(found, torch.cat([each.flatten() for each in by_hand]), rtol=1e-3, atol=1e-6)


def test_each_ray_has_random_numbers_of_its_own_wherever_the_batch_is_cut():
    random = batch_random(7, 6)
    whole = random_of_rays(random, 4).uniform("stratified", 3)
    assert whole.unique().numel() == 6 * 4 * 3
    parts = torch.cat([random_of_rays(random[part], 4).uniform("stratified", 3) for part in (slice(0, 2), slice(2, 6))])
    torch.testing.assert_close(parts, whole, rtol=0, atol=0)
    assert random_of_rays(random, 1) is random


def test_the_last_part_of_the_run_has_several_rays_and_a_new_attempt_begins_with_one():
    model = model_with(2, start=0.5)
    assert [rays_at(model, share) for share in (0.0, 0.49, 0.5, 1.0)] == [1, 1, 4, 4]
    model.reset_parameters()
    assert model.subpixels.per_pixel == 1


def rays_at(model, share):
    model.subpixels.on_step(StepContext(share, 0, 0))
    return model.subpixels.per_pixel


def test_a_checkpoint_renders_as_its_last_step_was():
    model, other = model_with(2), model_with(2)
    model.subpixels.on_step(StepContext(1.0, 0, 0))
    other.load_state_dict(model.state_dict())
    assert other.subpixels.per_pixel == 4
    with pytest.raises(InputError, match="3 a side"):
        other.load_state_dict(model.state_dict() | {"subpixels.now": torch.tensor(3)})


def test_one_ray_a_pixel_leaves_no_trace():
    model = model_with(1)
    model.subpixels.on_step(StepContext(1.0, 0, 0))
    assert not [name for name in model.state_dict() if "subpixels" in name]
    pixels = RayBatches(ball_scene(), make_step(None).progress, 0, 4).batch_at(0, 0).pixels
    rendering = model(rays_of(ball_scene())(pixels), None, None)[-1]
    assert mean_over_pixels(rendering, 1) is rendering


def test_losses_that_look_at_samples_and_sides_out_of_range_are_refused_by_name():
    for side in (0, 9):
        with pytest.raises((InputError, ValueError), match="subpixels"):
            Subpixels(side)
    train_step = make_step(None)
    with pytest.raises(InputError, match=r"model\.subpixels=2 .* ProposalLoss looks at the samples"):
        TrainStep(
            Objective(model_with(2), train_step.objective.rays, ProposalLoss(), "white"),
            *(train_step.build_optimizer, train_step.schedule, train_step.progress, 0),
        )

"""Several rays a pixel: a picture is the mean of a larger one, and a step compares that mean with the photograph."""

from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene, tiny_model
from support.steps import gradients, make_step, rays_of

from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import resized
from nerf_lightning.nerf.losses.proposal import ProposalLoss
from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.models.render_image import render_picture
from nerf_lightning.nerf.models.subpixels import Subpixels, for_each_ray, mean_over_pixels, random_of_rays
from nerf_lightning.nerf.part import StepContext
from nerf_lightning.nerf.randomness import batch_random, fold
from nerf_lightning.nerf.rendering.blending import blend
from nerf_lightning.training.step import TrainStep


def model_with(side, start=0.0, density_bias=0.5):
    torch.manual_seed(3)
    plain = tiny_model(density_bias=density_bias)
    model = RadianceModel(dict(plain.levels.items()), subpixels=side, subpixels_from=start)
    model.fit_to(ball_scene())
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
    rays, pixels = rays_of(scene), RayBatches(scene, make_step(None).progress, 0, 5).at(0, 0).pixels
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
    step = make_step(tile_points, model, background)
    found, losses = gradients(step, scene)
    batch, random = RayBatches(scene, make_step(None).progress, 0, 64).at(0, 0), batch_random(fold(0, 0, 0), 64)
    behind = random.uniform("background", 3) if background == "random" else torch.ones(64, 3)
    renderings = model(
        step.rays.of_pixels(batch.pixels, model.subpixels), for_each_ray(behind, 4), random_of_rays(random, 4)
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
    pixels = RayBatches(ball_scene(), make_step(None).progress, 0, 4).at(0, 0).pixels
    rendering = model(rays_of(ball_scene())(pixels), None, None)[-1]
    assert mean_over_pixels(rendering, 1) is rendering


def test_losses_that_look_at_samples_are_refused_by_name():
    step = make_step(None)
    with pytest.raises(InputError, match=r"model\.subpixels=2 .* ProposalLoss looks at the samples"):
        TrainStep(
            model_with(2), step.rays, ProposalLoss(), step.build_optimizer, step.schedule, step.progress, 0, "white"
        )


@pytest.mark.parametrize("side", [0, 9])
def test_sides_out_of_range_are_refused(side):
    with pytest.raises((InputError, ValueError), match="subpixels"):
        Subpixels(side)

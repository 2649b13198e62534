"""Masked pixels: they teach nothing and are not scored, and without masks no number changes by a bit."""

import copy
from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene, tiny_model
from support.steps import gradients, make_step

from nerf_lightning.data.ray_batches import FixedRays, RayBatches
from nerf_lightning.evaluation.evaluator import Scoring
from nerf_lightning.evaluation.metrics import image_metrics, masked_out
from nerf_lightning.evaluation.protocol import split_hash
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.samplers.space_carving import possible_cells
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.training.callbacks.collapse_guard import is_constant
from nerf_lightning.training.validation import RayErrors


def masked(scene, keep):
    """Leave out all pixels whose number, over all views, `keep` does not take."""
    mask = keep(torch.arange(len(scene.pixels.rgba))).to(torch.uint8)
    return replace(scene, pixels=replace(scene.pixels, mask=mask))


def garbled(scene):
    """Change the colors of the masked pixels."""
    rgba = scene.pixels.rgba.clone()
    rgba[scene.pixels.mask == 0] = torch.tensor([255, 0, 255, 255], dtype=torch.uint8)
    return replace(scene, pixels=replace(scene.pixels, rgba=rgba))


def test_the_loss_is_the_mean_over_unmasked_pixels():
    train_step, scene = make_step(None), masked(ball_scene(), lambda number: number % 3 > 0)
    batch = RayBatches(scene, Progress(), 0, 64).batch_at(0, 0)
    kept = batch.weight > 0
    assert 0 < int(kept.sum()) < 64
    seen = train_step.gradients(batch, train_step.key)
    train_step.objective.loss.forward = lambda renderings, target: {
        "kept": torch.stack([(each.rgb - target.rgb).square()[kept].mean() for each in renderings])
    }
    torch.testing.assert_close(seen.losses, train_step.gradients(batch, train_step.key).losses)


@pytest.mark.parametrize("tile_points", [16, 100])
def test_the_normaliser_is_the_batchs_not_the_tiles(tile_points):
    # Tiles then hold very different numbers of unmasked rays, some none.
    scene, model = masked(ball_scene(), lambda number: number % 7 == 0), tiny_model(density_bias=0.5)
    whole, losses = gradients(make_step(None, copy.deepcopy(model)), scene)
    tiled, tiled_losses = gradients(make_step(tile_points, copy.deepcopy(model)), scene)
    torch.testing.assert_close(tiled, whole, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(tiled_losses, losses, rtol=1e-5, atol=1e-7)
    assert float(whole.norm()) > 0


def test_the_colours_of_masked_pixels_do_not_matter():
    scene, model = masked(ball_scene(), lambda number: number % 2 > 0), tiny_model(density_bias=0.5)
    one, _ = gradients(make_step(None, copy.deepcopy(model)), scene)
    other, _ = gradients(make_step(None, copy.deepcopy(model)), garbled(scene))
    assert torch.equal(one, other)


def test_a_batch_of_masked_pixels_alone_has_no_gradient():
    gradient, losses = gradients(make_step(None), masked(ball_scene(), lambda number: number < 0))
    assert float(gradient.abs().max()) == 0
    assert losses.tolist() == [0.0, 0.0]


def validation_psnr(scene):
    train_step, errors = make_step(None), RayErrors()
    with torch.no_grad():
        for batch in FixedRays(scene, "val", 200, 64):
            errors.of(train_step.objective, batch, None)
    return errors.summary()["val/psnr"]


def test_validation_looks_at_unmasked_pixels():
    scene = masked(ball_scene(), lambda number: number % 2 > 0)
    assert validation_psnr(scene) == validation_psnr(garbled(scene)) != validation_psnr(ball_scene())


def test_a_validation_subset_without_unmasked_pixels_is_refused():
    scene = masked(ball_scene(), lambda number: number < 3 * 144)  # the training views
    with pytest.raises(InputError, match=r"masks of ball leave out all 50 pixels.* Raise data.val_rays"):
        FixedRays(scene, "val", 50, 20)
    FixedRays(scene, "train", 50, 20)
    FixedRays(masked(ball_scene(), lambda number: number == 3 * 144), "val", 10**6, 20)


def test_masked_rays_do_not_tell_the_guard_that_the_run_lives():
    kept = torch.arange(64) % 2 == 0
    light = torch.where(kept[:, None], 0.0, torch.rand(64, 3))
    step = {"target": torch.rand(64, 3), "foreground": light}
    assert is_constant(step | {"weight": kept.float()}, 0.02)
    assert not is_constant(step | {"weight": torch.ones(64)}, 0.02)
    assert not is_constant(step | {"weight": torch.zeros(64)}, 0.02)


def test_psnr_is_that_of_unmasked_pixels_and_ssim_sees_no_other_difference():
    truth = torch.rand(16, 16, 3)
    kept = torch.zeros(16, 16, dtype=torch.bool)
    kept[:, :4] = True
    render = truth + torch.where(kept[..., None], 0.0, 0.9)
    perfect = {"psnr": pytest.approx(100.0), "cc_psnr": pytest.approx(100.0), "ssim": pytest.approx(1.0)}
    assert image_metrics(render, truth, kept) == perfect
    truth = torch.full((16, 16, 3), 0.3)
    off = truth + 0.1
    assert image_metrics(off, truth, kept)["psnr"] == pytest.approx(20.0, abs=1e-3)
    noisy = truth + 0.2 * torch.rand(16, 16, 3)
    assert image_metrics(noisy, truth, kept)["ssim"] > image_metrics(noisy, truth)["ssim"]
    assert image_metrics(off, truth, torch.ones_like(kept)) == image_metrics(off, truth)
    assert masked_out(off, truth, None) is off


def test_scores_leave_masked_pixels_out_and_say_so(tmp_path):
    model = tiny_model(density_bias=0.5).eval()
    scene = masked(ball_scene(), lambda number: number % 2 > 0)
    scoring = Scoring(num_pictures=0)
    results = [scoring.score(model, each, "white", 1000, tmp_path) for each in (scene, garbled(scene), ball_scene())]
    assert results[0]["psnr"] == results[1]["psnr"] != results[2]["psnr"]
    assert results[0]["protocol"]["masks"] == "left out"
    assert results[2]["protocol"]["masks"] == "none"
    views = [3, 4]
    assert split_hash(scene, views) != split_hash(ball_scene(), views)


def test_what_is_masked_carves_nothing(generator):
    scene = ball_scene(num_views=8, size=24)
    opaque = replace(scene, pixels=replace(scene.pixels, has_transparency=False))
    centers = 1.2 * torch.rand(500, 3, generator=generator) - 0.6
    centers[:, 2] += 0.8
    seen = possible_cells(opaque, centers, 0.05)
    assert torch.equal(possible_cells(masked(scene, lambda number: number < 0), centers, 0.05), seen)
    assert int(possible_cells(scene, centers, 0.05).sum()) < int(seen.sum())

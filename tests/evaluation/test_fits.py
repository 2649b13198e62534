"""Colors and cameras that are fitted to a photograph before they are compared."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from support.known_fields import photographed_ball
from support.planted_exposures import with_stops
from support.scenes import ball_scene, tiny_model
from support.wrong_cameras import with_noise

from nerf_lightning.evaluation import evaluator
from nerf_lightning.evaluation.camera_fit import fitted_camera
from nerf_lightning.evaluation.color_fit import color_corrected, exposure_fitted
from nerf_lightning.evaluation.evaluator import Scoring
from nerf_lightning.evaluation.metrics import image_metrics
from nerf_lightning.evaluation.protocol import differences
from nerf_lightning.nerf.models.render_image import Picture
from nerf_lightning.nerf.rendering.background import photograph
from nerf_lightning.nerf.rendering.linear_light import scale_light

GAINS = torch.tensor([1.6, 0.7, 1.1])


def picture():
    return torch.rand(16, 20, 3, generator=torch.Generator().manual_seed(0)) * 0.6 + 0.1


def test_an_affine_change_of_colours_is_undone_by_least_squares_without_what_a_mask_leaves_out():
    truth, matrix = picture(), torch.tensor([[0.9, 0.1, 0.0], [0.0, 0.8, 0.1], [0.05, 0.0, 1.1]])
    render = (truth - 0.02) @ matrix.inverse()
    torch.testing.assert_close(color_corrected(render, truth), truth, atol=1e-5, rtol=0)
    render, truth = picture(), picture().flip(0)
    ones = torch.cat([render, torch.ones(16, 20, 1)], dim=-1).reshape(-1, 4)
    solved = ones @ torch.linalg.lstsq(ones.double(), truth.reshape(-1, 3).double()).solution.float()
    torch.testing.assert_close(color_corrected(render, truth).reshape(-1, 3), solved, atol=1e-5, rtol=0)
    truth, kept = picture(), torch.zeros(16, 20, dtype=torch.bool)
    kept[4:12] = True
    render = (truth * 0.5).where(kept[..., None], 0.9)
    torch.testing.assert_close(color_corrected(render, truth, kept)[kept], truth[kept], atol=1e-5, rtol=0)
    flat = torch.full((16, 20, 3), 0.25)
    torch.testing.assert_close(color_corrected(flat, flat + 0.5), flat + 0.5)
    assert torch.equal(color_corrected(render, truth, torch.zeros_like(kept)), render)


def test_a_picture_has_both_numbers_fitting_never_harms_and_nothing_is_fitted_to_one_of_one_colour():
    truth = picture()
    found = image_metrics(scale_light(truth, GAINS), truth)
    assert found["psnr"] < 24 < found["cc_psnr"] - 10
    same = image_metrics(truth, truth)
    assert same["psnr"] == same["cc_psnr"] == 100.0
    truth, flat, left = picture(), torch.full((16, 20, 3), 0.3), torch.zeros(16, 20, dtype=torch.bool)
    left[:, :10] = True
    assert image_metrics(flat, truth)["cc_psnr"] is image_metrics(truth, flat + 1e-4 * truth)["cc_psnr"] is None
    half = flat.where(left[..., None], truth)
    assert image_metrics(truth, half, left)["cc_psnr"] is None
    assert image_metrics(truth, half)["cc_psnr"] is not None


def test_exposure_is_fitted_to_some_of_the_pixels_and_the_background_keeps_its_colour():
    truth, opacity, left = picture(), torch.ones(16, 20), torch.zeros(16, 20, dtype=torch.bool)
    opacity[:3], left[:, :10] = 0.0, True
    render = scale_light(truth, 1.0 / GAINS)
    render[:3] = truth[:3]
    for behind in (None, torch.ones(1, 3)):
        torch.testing.assert_close(exposure_fitted(render, truth, opacity, left, behind), truth, atol=1e-4, rtol=0)
        assert torch.equal(exposure_fitted(render, truth, opacity, torch.zeros_like(left), behind), render)


def test_the_light_of_half_covered_pixels_is_fitted_and_the_background_in_them_stays():
    """As a correction that trains does it: the gain is on the scene's own light, before the background comes."""
    light, opacity = picture(), torch.rand(16, 20, generator=torch.Generator().manual_seed(1)) * 0.8 + 0.2
    left = torch.zeros(16, 20, dtype=torch.bool)
    left[:, :10] = True

    def over_white(straight):
        return opacity[..., None] * straight + (1.0 - opacity[..., None])

    render, truth = over_white(scale_light(light, 1.0 / GAINS)), over_white(light)
    found = exposure_fitted(render, truth, opacity, left, torch.ones(1, 3))
    torch.testing.assert_close(found, truth, atol=1e-4, rtol=0)


@pytest.fixture
def scored(monkeypatch, tmp_path):
    """Score pictures of the ball, which are right but for exposure, and for a fault in the left halves."""
    scene = ball_scene(num_views=6, size=24, background="none")
    truth = with_stops(scene, torch.zeros(len(scene.splits["train"]), 3), dim=0.5)

    def render(model, rays, view, background, tile_points):
        rgb = photograph(scene, view, background)
        return Picture(rgb, torch.ones(24, 24), torch.ones(24, 24))

    monkeypatch.setattr(evaluator, "render_picture", render)

    def score(colors) -> dict:
        with torch.no_grad():
            return Scoring(colors=colors).score(tiny_model(), truth, "none", 4096, Path(tmp_path))

    return score


def test_the_protocol_says_which_number_it_is(scored):
    raw, half = scored("raw"), scored("half_fit")
    assert raw["protocol"]["colors"] == "raw"
    assert half["protocol"]["colors"].endswith("scored on the right")
    assert raw["psnr"] < 25
    assert half["psnr"] > 40
    assert raw["cc_psnr"] > raw["psnr"] + 5
    assert [word.partition(":")[0] for word in differences(raw["protocol"], half["protocol"])] == ["colors"]


def test_a_wrong_camera_comes_to_see_its_photograph():
    true, model = photographed_ball()
    scene = with_noise(true, 1.0, 0.01)
    with torch.no_grad():
        found = fitted_camera(model, scene, 5, "black", 1 << 16).c2w
    before, after = ((each[5] - true.cameras.c2w[5]).abs().max() for each in (scene.cameras.c2w, found))
    assert float(after) < 0.5 * float(before)
    others = [0, 1, 2, 3, 4, 6, 7]
    assert torch.equal(found[others], scene.cameras.c2w[others])


def scored_with(scene, model, folder):
    scoring = Scoring(split="test", num_pictures=0, num_worst=0)
    with torch.no_grad():
        return scoring.score(model, scene, "black", 1 << 16, folder)


def test_refined_scenes_are_scored_with_fitted_cameras_and_the_protocol_says_so(tmp_path):
    true, model = photographed_ball()
    true = replace(true, splits={"train": (0, 1, 2, 3), "test": (4, 5)})
    wrong = with_noise(true, 1.0, 0.01)
    raw, refined = scored_with(wrong, model, tmp_path), scored_with(replace(wrong, refined=True), model, tmp_path)
    assert (raw["protocol"]["cameras"], refined["protocol"]["cameras"]) == ("raw", "refined")
    assert refined["psnr"] > raw["psnr"] + 6.0


def test_an_empty_mask_leaves_something_to_look_at_and_the_model_learns_nothing_meanwhile():
    _, model = photographed_ball(size=8)
    scene = ball_scene(num_views=8, size=8, background="black")
    masked = replace(scene, pixels=replace(scene.pixels, mask=torch.zeros(8 * 64, dtype=torch.uint8)))
    assert bool(torch.isfinite(fitted_camera(model, masked, 0, "black", 1 << 16).c2w).all())
    assert all(parameter.grad is None and parameter.requires_grad for parameter in model.parameters())

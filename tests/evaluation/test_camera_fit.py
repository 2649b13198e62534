"""A test camera is fitted to its photograph, and nothing but the camera is."""

from dataclasses import replace

import torch
from support.known_fields import photographed_ball
from support.scenes import ball_scene
from support.wrong_cameras import with_noise

from nerf_lightning.evaluation.camera_fit import fitted_camera
from nerf_lightning.evaluation.evaluator import Scoring


def test_a_wrong_camera_comes_to_see_its_photograph():
    true, model = photographed_ball()
    scene = with_noise(true, 1.0, 0.01)
    with torch.no_grad():
        found = fitted_camera(model, scene, 5, "black", 1 << 16).c2w
    before, after = ((each[5] - true.cameras.c2w[5]).abs().max() for each in (scene.cameras.c2w, found))
    assert float(after) < 0.5 * float(before)
    others = [0, 1, 2, 3, 4, 6, 7]
    assert torch.equal(found[others], scene.cameras.c2w[others])


def test_the_model_learns_nothing_meanwhile():
    true, model = photographed_ball(size=8)
    fitted_camera(model, with_noise(true, 1.0, 0.01), 0, "black", 1 << 16)
    assert all(parameter.grad is None and parameter.requires_grad for parameter in model.parameters())


def scored(scene, model, folder):
    scoring = Scoring(split="test", num_pictures=0, num_worst=0)
    with torch.no_grad():
        return scoring.score(model, scene, "black", 1 << 16, folder)


def test_refined_scenes_are_scored_with_fitted_cameras_and_the_protocol_says_so(tmp_path):
    true, model = photographed_ball()
    true = replace(true, splits={"train": (0, 1, 2, 3), "test": (4, 5)})
    wrong = with_noise(true, 1.0, 0.01)
    raw, refined = scored(wrong, model, tmp_path), scored(replace(wrong, refined=True), model, tmp_path)
    assert (raw["protocol"]["cameras"], refined["protocol"]["cameras"]) == ("raw", "refined")
    assert refined["psnr"] > raw["psnr"] + 6.0


def test_an_empty_mask_leaves_something_to_look_at():
    _, model = photographed_ball(size=8)
    scene = ball_scene(num_views=8, size=8, background="black")
    masked = replace(scene, pixels=replace(scene.pixels, mask=torch.zeros(8 * 64, dtype=torch.uint8)))
    assert bool(torch.isfinite(fitted_camera(model, masked, 0, "black", 1 << 16).c2w).all())

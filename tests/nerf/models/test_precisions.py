"""The same weights see the same in float32 and in bfloat16, in every kind of model of conf/model."""

import pytest
from support.configs import composed, options
from support.scenes import ball_scene
from support.steps import rays_of

from nerf_lightning.config.instantiate import build
from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.evaluation.metrics import image_metrics, mean_over_images
from nerf_lightning.nerf.losses.base import Loss
from nerf_lightning.nerf.matmul_precision import set_precision
from nerf_lightning.nerf.models.base import show_photographs
from nerf_lightning.nerf.models.render_image import render_picture
from nerf_lightning.nerf.objective import Objective
from nerf_lightning.nerf.part import fit_parts
from nerf_lightning.nerf.rendering.background import photograph
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.training.attempts import draw_weights
from nerf_lightning.training.step import TrainStep

# Enough to see a ball. Where a CPU has no bfloat16 it is emulated, and the largest MLP takes half a minute.
STEPS, RAYS, SIDE, TILE_POINTS = 30, 64, 16, 8192
LESS = {"nerf_occupancy": (20, 16, 12), "view_transformer_tiny": (15, 32, 12)}
# It renders each view from others.
LOOKING = "view_transformer_tiny"
# One of the others, or of the code of a smaller one, which is tried.
SAME = ("auto", "fast", "fast_large", "nerf", "nerf_small", "view_transformer")
# One of each kind; make test-slow has the others, which are larger.
ALWAYS = ("nerf_tiny", "fast_small", "fast_proposal", "view_transformer_tiny")
# Two of four: from both sides.
SEEN_FROM = (0, 2)


def trained(name, scene):
    # Few frequencies: a field that is half trained at many is noise, of which any change makes other noise.
    config = composed("train", f"model={name}", *["encoder.num_frequencies=4"] * name.startswith("nerf"))
    if "levels" in config.model and "resolution" in config.model.levels.fine.sampler:
        config.model.levels.fine.sampler.update(resolution=32, num_steps=128)  # carved in a moment
    model, loss = build(config.model), build(config.loss)
    assert isinstance(loss, Loss)
    fit_parts(model, scene)
    show_photographs(model, scene)
    progress, (steps, rays, _) = Progress(), LESS.get(name, (STEPS, RAYS, SIDE))
    train_step = TrainStep(
        Objective(model, rays_of(scene), loss, background_of(name)), build(config.optimizer), build(config.scheduler),
        progress, 2, TILE_POINTS, num_steps=steps,
    )  # fmt: skip
    draw_weights(train_step)
    set_precision(model, "bfloat16")
    batches, optimizer = RayBatches(scene, progress, 0, rays), train_step.new_optimizer()
    for _ in range(steps):
        train_step(batches.batch_at(0, progress.rays_seen), optimizer)
    return model.eval()


def background_of(name):
    return "white" if name == LOOKING else "random"


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(each, marks=() if each in ALWAYS else pytest.mark.minutes)
        for each in options("model")
        if each not in SAME
    ],
)
def test_weights_see_the_same_in_both_precisions(name):
    *_, side = LESS.get(name, (STEPS, RAYS, SIDE))
    scene = ball_scene(num_views=24 if name == LOOKING else 4, size=side)
    model, found = trained(name, scene), {}
    for matmul_precision in ("float32", "bfloat16"):
        set_precision(model, matmul_precision)
        measured = []
        for view in SEEN_FROM:
            picture = render_picture(model, rays_of(scene), view, "white", TILE_POINTS)
            measured.append(image_metrics(picture.rgb, photograph(scene, view, "white")))
        # Of several views, as evaluations are: the coarse level moves the fine one's samples a little, and a field
        # that is half trained shows each move.
        found[matmul_precision] = mean_over_images(measured)
    assert abs(found["float32"]["psnr"] - found["bfloat16"]["psnr"]) < 0.05
    assert abs(found["float32"]["ssim"] - found["bfloat16"]["ssim"]) < 0.001
    assert found["float32"] != found["bfloat16"]  # they were computed differently

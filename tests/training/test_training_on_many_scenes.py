"""A model of many scenes in the step of training: which photographs it sees, resumed, shared, and judged elsewhere."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from support.scenes import ball_scene

from nerf_lightning.compute import ranks
from nerf_lightning.data.captures.joined import joined
from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.evaluation.evaluator import Scoring
from nerf_lightning.nerf.losses.mse import MeanSquaredError
from nerf_lightning.nerf.models.looking import show_photographs
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import render_picture
from nerf_lightning.nerf.models.view_transformer.model import ViewTransformer
from nerf_lightning.nerf.optimizers.schedule import ExponentialDecay
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.training.step import TrainStep

RAYS = 24


def scenes(unseen=("c",)):
    """Three balls of other colours and sizes of pictures; the last is never trained on."""
    made = {}
    for number, name in enumerate("abc"):
        ball = ball_scene(num_views=8, size=10 + 2 * number)
        store = ball.pixels
        rgba = torch.cat([store.rgba[:, :3].roll(number, dims=1), store.rgba[:, 3:]], dim=1)
        made[name] = replace(ball, pixels=replace(store, rgba=rgba))
    return joined(made, unseen, "balls")


def make_model(scene):
    torch.manual_seed(0)
    model = ViewTransformer(
        StratifiedSampler(num_samples=6),
        width=8,
        blocks=2,
        heads=2,
        num_sources=2,
        image_features=4,
        image_scale=2,
        image_width=4,
        image_blocks=0,
    )
    show_photographs(model, scene)
    return model


def make_step(scene, tile_points=None, lr=1e-2):
    model = make_model(scene)
    return TrainStep(
        model=model,
        rays=RayGenerator.of_views(scene, model),
        loss=MeanSquaredError(),
        optimizer=lambda groups: torch.optim.SGD(groups, lr=lr, momentum=0.9),
        schedule=ExponentialDecay(decay_rate=0.5),
        progress=Progress(),
        num_steps=10,
        seed=3,
        background=scene.background,
        tile_points=tile_points,
    )


def train(step, scene, steps, optimizer=None):
    loader = RayBatches(scene, step.progress, 3, RAYS, views=2)
    optimizer = optimizer or step.new_optimizer()
    for _ in range(steps):
        seen = step(loader.at(0, step.progress.rays_seen), optimizer)
    return optimizer, seen


def weights(step):
    return torch.cat([parameter.detach().flatten() for parameter in step.model.parameters()])


def test_a_run_that_is_gone_on_with_has_the_bits_of_one_that_never_stopped():
    scene = scenes()
    whole, stopped, again = make_step(scene), make_step(scene), make_step(scene)
    train(whole, scene, 4)
    optimizer, _ = train(stopped, scene, 2)
    again.model.load_state_dict(stopped.model.state_dict())
    loader = RayBatches(scene, again.progress, 3, RAYS, views=2)
    again.progress.take_up(stopped.progress)
    taken_up = again.new_optimizer()
    taken_up.load_state_dict(optimizer.state_dict())
    for _ in range(2):
        again(loader.at(0, again.progress.rays_seen), taken_up)
    assert torch.equal(weights(again), weights(whole))
    assert not torch.equal(weights(stopped), weights(whole))


def test_two_processes_follow_one(monkeypatch):
    scene = scenes()
    one = make_step(scene, lr=0.0)
    _, seen = train(one, scene, 1)
    whole = torch.cat([parameter.grad.flatten() for parameter in one.model.parameters()])
    total, losses = 0.0, 0.0
    for number in range(2):
        monkeypatch.setattr(ranks, "world_size", lambda: 2)
        monkeypatch.setattr(ranks, "rank", lambda number=number: number)
        monkeypatch.setattr(ranks, "add_up", lambda tensors: list(tensors))
        monkeypatch.setattr(ranks, "total", lambda own: torch.tensor(float(RAYS)))
        part = make_step(scene, lr=0.0)
        _, of_part = train(part, scene, 1)
        total = total + torch.cat([parameter.grad.flatten() for parameter in part.model.parameters()])
        losses = losses + of_part.losses
    assert torch.allclose(total, whole, atol=1e-6)
    assert torch.allclose(losses, seen.losses, rtol=1e-5)


def test_rays_know_their_capture_and_whose_pixels_they_are():
    scene = scenes()
    rays_of = RayGenerator.of_views(scene, make_model(scene))
    view = torch.tensor([0, 9, 23])
    rays = rays_of(PixelIndex(view, torch.zeros_like(view), torch.zeros_like(view)))
    assert rays.capture.tolist() == [0, 1, 2]
    assert torch.equal(rays.photograph, view)


def test_a_view_is_rendered_from_its_own_capture_and_never_from_itself():
    """Whatever is painted over the view itself, and over all other captures, its picture stays."""
    scene = scenes()
    view = scene.splits["train"][1]
    painted = scene.pixels.rgba.clone()
    start, count = int(scene.pixels.offset[view]), int(scene.pixels.width[view] * scene.pixels.height[view])
    painted[start : start + count] = 7
    painted[int(scene.pixels.offset[8]) :] = 9
    pictures = []
    for rgba in (scene.pixels.rgba, painted):
        shown = replace(scene, pixels=replace(scene.pixels, rgba=rgba))
        model = make_model(shown).eval()
        pictures.append(render_picture(model, RayGenerator.of_views(shown, model), view, "white", 10_000).rgb)
    assert torch.equal(*pictures)


def test_an_unseen_scene_is_scored_by_name_beside_what_its_photographs_give(tmp_path: Path):
    scene = scenes()
    metrics = Scoring(num_pictures=0, num_worst=0, nearest_views=2).score(
        make_model(scene).eval(), scene, "white", 10_000, tmp_path
    )
    assert list(metrics["captures"]) == ["c"]
    assert metrics["captures"]["c"]["psnr"] == pytest.approx(metrics["psnr"])
    assert metrics["captures"]["c"]["trained_on"] is False
    assert metrics["nearest_views"]["nearest"] > 5.0
    assert all(row["unseen"] == 0.0 for row in metrics["per_image"])


def test_who_looks_elsewhere_is_told_how_much_no_photograph_sees(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    scene = scenes(unseen=())
    away = scene.cameras.c2w.clone()
    view = scene.splits["test"][0]
    away[view, :, 3] += 40.0 * away[view, :, 0]
    scene = replace(scene, cameras=replace(scene.cameras, c2w=away))
    metrics = Scoring(max_views=1, num_pictures=0, num_worst=0).score(
        make_model(scene).eval(), scene, "white", 10_000, tmp_path
    )
    assert metrics["per_image"][0]["unseen"] > 0.5
    assert "no photograph sees" in caplog.text

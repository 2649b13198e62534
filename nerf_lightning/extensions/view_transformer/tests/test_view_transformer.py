"""A model of many scenes as a whole: what changes nothing, what it is compared with, and what it refuses."""

from dataclasses import replace

import pytest
import torch
from looking import looking_model, rays_of_views
from support.scenes import ball_scene

from nerf_lightning.commands.train_job.evaluate_and_film import PostTraining
from nerf_lightning.evaluation.evaluator import Scoring
from nerf_lightning.extensions.many_scenes.joined import joined
from nerf_lightning.extensions.splats.page import PageExport
from nerf_lightning.extensions.view_transformer.nearest_view import NearestViews
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.models.base import point_field, show_photographs
from nerf_lightning.nerf.randomness import batch_random
from nerf_lightning.nerf.rendering.background import photograph

KINDS = [{}, {"experts": 4}, {"start": "spread", "color": "blended"}, {"image_norm": "neurn"}]


def rendered(model, rays, key=None):
    count = len(rays.near)
    return model(rays, torch.ones(count, 3), None if key is None else batch_random(key, count))[0]


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_neither_tiles_nor_the_order_of_photographs_change_anything(kind):
    scene = ball_scene()
    model, rays = looking_model(scene, [0, 2, 3, 4, 5], num_sources=5, **kind).eval(), rays_of_views(scene, [1])
    whole = rendered(model, rays)
    torch.testing.assert_close(rendered(model, rays[5:9]).rgb, whole.rgb[5:9], atol=1e-5, rtol=1e-4)
    other = rendered(looking_model(scene, [4, 0, 5, 3, 2], num_sources=5, **kind).eval(), rays)
    torch.testing.assert_close(other.rgb, whole.rgb, atol=1e-5, rtol=1e-4)
    assert ((whole.depth > rays.near) & (whole.depth < rays.far)).all()


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_every_weight_learns_and_is_a_function_of_the_seed_alone(kind):
    scene, model = ball_scene(), looking_model(**kind)
    seen = rendered(model, rays_of_views(scene, [0, 4]), 3)
    (seen.rgb.square().mean() + (0.0 if seen.penalty is None else seen.penalty.mean())).backward()
    assert all(each.grad is not None and each.grad.isfinite().all() for each in model.parameters())
    states = []
    for value in (7.0, 9.0):
        for parameter in model.parameters():
            torch.nn.init.constant_(parameter, value)
        torch.manual_seed(5)
        model.reset_parameters()
        states.append({name: each.clone() for name, each in model.state_dict().items()})
    assert all(torch.equal(states[0][name], each) for name, each in states[1].items())


def test_a_view_does_not_depend_on_its_own_photograph():
    scene = ball_scene()
    altered = scene.pixels.rgba.clone()
    altered[scene.pixels.offset[2] : scene.pixels.offset[3]] = 0
    other = replace(scene, pixels=replace(scene.pixels, rgba=altered))
    for view, same in ((2, True), (3, False)):
        rays = rays_of_views(scene, [view])
        assert torch.equal(*(rendered(looking_model(each), rays, 1).rgb for each in (scene, other))) is same


def test_where_no_photograph_sees_anything_the_background_is_shown_and_said(caplog):
    scene = ball_scene()
    model, rays = looking_model(scene).eval(), rays_of_views(scene, [1])
    away = replace(rays, directions=-rays.directions, view_directions=-rays.view_directions, origins=100 * rays.origins)
    assert rendered(model, rays).opacity.min() == 1.0
    seen = rendered(model, away)
    assert torch.equal(seen.rgb, torch.ones_like(seen.rgb))
    assert torch.equal(seen.opacity, torch.zeros_like(seen.depth))
    assert "no photograph sees most of the rays" in caplog.text


def test_an_unseen_scene_is_scored_beside_what_its_photographs_give(tmp_path):
    scene = joined({name: ball_scene(num_views=8, size=12) for name in "ab"}, ("b",), "balls")
    model = looking_model(scene, scene.sources, num_sources=2).eval()
    show_photographs(model, scene)
    scoring = Scoring(num_pictures=0, num_worst=0, nearest_views=2)
    metrics = scoring.score(model, scene, "white", 10_000, tmp_path)
    assert list(metrics["captures"]) == ["b"]
    assert metrics["nearest_views"]["nearest"] > 5.0
    assert all(row["unseen"] == 0.0 for row in metrics["per_image"])


def test_where_a_photograph_was_taken_from_it_is_shown_and_never_the_views_own():
    scene = ball_scene(num_views=8)
    c2w, view, train = scene.cameras.c2w.clone(), scene.splits["test"][0], scene.splits["train"]
    c2w[view] = c2w[train[1]]
    scene = replace(scene, cameras=replace(scene.cameras, c2w=c2w))
    shown = photograph(scene, train[1], "white")
    for picture in NearestViews(scene, "white", 2).pictures(view).values():
        torch.testing.assert_close(picture, shown, atol=0.02, rtol=0.0)
    other = NearestViews(scene, "white", 1).pictures(train[1])["nearest"]
    assert float((other - shown).abs().max()) > 0.2


def test_what_it_cannot_look_at_or_tell_is_refused_by_name():
    with pytest.raises(InputError, match=r"from 4 photographs.* has 3 .*model\.num_sources=2"):
        looking_model(ball_scene(), [0, 1, 2], num_sources=4)
    with pytest.raises(InputError, match=r"scene\.background=white"):
        looking_model(ball_scene(background="random"))
    with pytest.raises(InputError, match="ViewTransformer renders rays and has neither density nor color"):
        point_field(looking_model())
    with pytest.raises(InputError, match="neither surfaces nor volumes can be exported"):
        PostTraining(None, None, {"page": PageExport()}).require_density(looking_model())
    for changes in ({"width": 10, "heads": 4}, {"image_scale": 3}, {"experts": 2}, {"blocks": 0}):
        with pytest.raises(ValueError, match=next(reversed(changes))):
            looking_model(**changes)

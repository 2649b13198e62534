"""A model of many scenes as a whole: what it looks at, and what changes nothing."""

from dataclasses import replace

import pytest
import torch
from support.looking import SETTINGS, looking_model, rays_of_views
from support.scenes import ball_scene

from nerf_lightning.errors import InputError
from nerf_lightning.nerf.geometry.photographs import photographs_of
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import render_picture
from nerf_lightning.nerf.models.view_transformer.experts import Experts
from nerf_lightning.nerf.models.view_transformer.model import ViewTransformer
from nerf_lightning.nerf.randomness import batch_random
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler
from nerf_lightning.nerf.types.points import Points


def rendered(model, rays, key=None):
    count = len(rays.near)
    random = None if key is None else batch_random(key, count)
    return model(rays, torch.ones(count, 3), random)[0]


def test_the_order_of_photographs_changes_nothing():
    scene = ball_scene()
    rays = rays_of_views(scene, [1])
    first = rendered(looking_model(scene, [0, 2, 3, 4, 5], num_sources=5), rays)
    second = rendered(looking_model(scene, [4, 0, 5, 3, 2], num_sources=5), rays)
    torch.testing.assert_close(second.rgb, first.rgb, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(second.depth, first.depth, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("experts", [0, 4])
def test_tiles_and_targets_beside_a_ray_change_nothing(experts):
    scene = ball_scene(size=16)
    model = looking_model(scene, experts=experts).eval()
    rays = rays_of_views(scene, [1, 3, 5], every=3)
    with torch.no_grad():
        whole = rendered(model, rays)
        for number in (0, 100, 255):
            torch.testing.assert_close(rendered(model, rays[number : number + 1]).rgb, whole.rgb[number : number + 1])
        of_views = RayGenerator.of_views(scene, model)
        pictures = [render_picture(model, of_views, 2, "white", points) for points in (300, 10**6)]
    torch.testing.assert_close(pictures[0].rgb, pictures[1].rgb, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(pictures[0].depth, pictures[1].depth, atol=1e-4, rtol=1e-4)


def test_a_training_step_is_the_same_in_tiles():
    scene = ball_scene()
    model = looking_model(scene)
    rays = rays_of_views(scene, [1, 3])
    random = batch_random(9, len(rays.near))
    whole = model(rays, None, random)[0]
    part = slice(5, 30)
    torch.testing.assert_close(model(rays[part], None, random[part])[0].rgb, whole.rgb[part], atol=1e-5, rtol=1e-4)


def test_a_view_does_not_depend_on_its_own_photograph():
    scene = ball_scene()
    altered = scene.pixels.rgba.clone()
    altered[scene.pixels.offset[2] : scene.pixels.offset[3]] = 0
    other = replace(scene, pixels=replace(scene.pixels, rgba=altered))
    for key in (None, 1, 2):
        of_itself, of_another = (
            [rendered(looking_model(each), rays_of_views(scene, [view]), key).rgb for each in (scene, other)]
            for view in (2, 3)
        )
        assert torch.equal(*of_itself)
        assert not torch.equal(*of_another)


def test_where_no_photograph_sees_anything_the_background_is_shown_and_said(caplog):
    scene = ball_scene()
    model = looking_model(scene).eval()
    rays = rays_of_views(scene, [1])
    away = replace(rays, directions=-rays.directions, view_directions=-rays.view_directions)
    away = replace(away, origins=100.0 * rays.origins)
    assert rendered(model, rays).opacity.min() == 1.0
    assert rendered(model.train(), away).opacity.max() == 0.0
    assert not caplog.text
    model.eval()
    seen = rendered(model, away)
    assert torch.equal(seen.rgb, torch.ones_like(seen.rgb))
    assert torch.equal(seen.opacity, torch.zeros_like(seen.depth))
    assert "no photograph that is looked at sees anything" in caplog.text
    for key in (None, 4):
        model.zero_grad()
        (rendered(model, away, key).foreground.sum() + rendered(model, rays, key).rgb.sum()).backward()
        assert all(each.grad is None or each.grad.isfinite().all() for each in model.parameters())


def test_depth_lies_between_near_and_far():
    scene = ball_scene()
    seen = rendered(looking_model(scene), rays := rays_of_views(scene, [1, 2]))
    assert ((seen.depth > rays.near) & (seen.depth < rays.far)).all()
    torch.testing.assert_close(seen.weights.sum(dim=-1), torch.ones_like(seen.depth))


def test_samples_of_deep_rays_are_even_in_inverse_distance():
    scene = ball_scene()
    model, rays = looking_model(scene), rays_of_views(scene, [1], every=40)
    deep = replace(rays, near=torch.full_like(rays.near, 0.5), far=torch.full_like(rays.far, 100.0))
    for each, spaced in ((rays, lambda t: t), (deep, lambda t: 1.0 / t)):
        edges = rendered(model, each).samples.edges
        steps = spaced(edges).diff(dim=-1)
        torch.testing.assert_close(steps, steps[..., :1].expand(steps.shape), rtol=1e-3, atol=1e-5)
        torch.testing.assert_close(edges[..., 0], each.near)
        torch.testing.assert_close(edges[..., -1], each.far)


def test_experts_stand_in_every_second_block():
    model = looking_model(blocks=5, experts=3)
    assert [isinstance(block.after_views, Experts) for block in model.blocks] == [False, True, False, True, False]


@pytest.mark.parametrize("changes", [{"experts": 4}, {"image_norm": "neurn"}, {"image_norm": "instance"}])
def test_it_is_made_without_memory_as_a_checkpoint_is_opened(changes):
    with torch.device("meta"):
        model = ViewTransformer(StratifiedSampler(4), **SETTINGS, **changes)
    assert all(weight.is_meta for weight in model.parameters())


def test_weights_are_a_function_of_the_seed_alone():
    states = []
    for _ in range(2):
        model = looking_model(experts=4)
        for parameter in model.parameters():
            torch.nn.init.constant_(parameter, 7.0)
        torch.manual_seed(5)
        model.reset_parameters()
        states.append(model.state_dict())
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])
    assert not any(bool((value == 7.0).any()) for value in states[0].values())


def test_no_photograph_is_part_of_its_state():
    scene = ball_scene()
    model, other = looking_model(scene), looking_model(scene, [0, 1, 2, 3])
    assert model.state_dict().keys() == other.state_dict().keys()
    assert (
        sum(value.numel() for value in model.state_dict().values()) < sum(p.numel() for p in model.parameters()) + 100
    )


def test_density_is_refused_by_name():
    model = looking_model()
    for ask in (lambda: model.density(torch.zeros(1, 3)), lambda: model.at(Points(torch.zeros(1, 3)))):
        with pytest.raises(InputError, match="model=view_transformer"):
            ask()


def test_fewer_photographs_than_source_views_are_refused():
    with pytest.raises(InputError, match=r"from 4 photographs.* has 3 .*model\.num_sources=2"):
        looking_model(ball_scene(), [0, 1, 2], num_sources=4)


def test_a_random_background_is_refused():
    with pytest.raises(InputError, match=r"scene\.background=white"):
        looking_model(ball_scene(background="random"))


@pytest.mark.parametrize("changes", [{"width": 10, "heads": 4}, {"image_scale": 3}, {"experts": 2}, {"blocks": 0}])
def test_settings_that_do_not_fit_are_refused(changes):
    with pytest.raises(ValueError, match=next(reversed(changes))):
        looking_model(**changes)


def test_it_looks_at_other_photographs_when_told():
    scene, model = ball_scene(), looking_model(ball_scene(), [0, 1, 2])
    rays = rays_of_views(scene, [5])
    first = rendered(model, rays).rgb
    model.look_at(photographs_of(scene, [3, 4, 0]))
    assert not torch.equal(rendered(model, rays).rgb, first)

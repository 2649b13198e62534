from dataclasses import replace

import pytest
import torch
from support.configs import composed
from support.scenes import ball_scene
from support.steps import make_step

from nerf_lightning.config.instantiate import build
from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.activations import color_from, density_from
from nerf_lightning.nerf.encoders.frequency import FrequencyEncoder
from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.encoders.spherical_harmonics import SphericalHarmonicsEncoder
from nerf_lightning.nerf.fields.ngp_field import NGPField
from nerf_lightning.nerf.models.render_image import render_picture
from nerf_lightning.nerf.part import fit_parts
from nerf_lightning.nerf.types.rays import Points


def a_field(**settings):
    torch.manual_seed(2)
    encoder = HashGridEncoder(num_levels=3, log2_table_size=9, max_resolution=40)
    torch.nn.init.normal_(encoder.table)
    return NGPField(encoder, SphericalHarmonicsEncoder(3), width=16, **settings)


def without_alpha(scene):
    rgba = scene.pixels.rgba.clone()
    rgba[:, 3] = 255
    return replace(scene, pixels=replace(scene.pixels, rgba=rgba, has_transparency=False))


def test_a_box_is_only_a_change_of_units():
    """The field of a scene that is moved and scaled is the same field, moved and scaled."""
    field, points = a_field(density_bias=-1.0), 2 * torch.rand(40, 3) - 1
    before = field.density(Points(points))[0]
    shift, scale = torch.tensor([3.0, -1.0, 7.0]), torch.tensor([2.0, 0.5, 4.0])
    field.fit_to(replace(ball_scene(), aabb=torch.stack([shift - scale, shift + scale])))
    torch.testing.assert_close(field.density(Points(points * scale + shift))[0], before, rtol=1e-3, atol=1e-4)


def test_outside_of_the_box_there_is_nothing_unless_space_is_contracted():
    points = torch.tensor([[1.2, 0.0, 0.0], [0.0, -40.0, 3.0]])
    assert bool((a_field().density(Points(points))[0] == 0).all())
    far = a_field(contraction=True)
    assert bool((far.density(Points(points))[0] > 0).all())
    assert far.density(Points(points[:1]))[0] != far.density(Points(2 * points[:1]))[0]


def test_the_exponential_and_its_gradient_stay_finite():
    raw = torch.tensor([-200.0, -1.0, 0.0, 14.0, 80.0, 1e6], requires_grad=True)
    density = density_from(raw)
    density.sum().backward()
    assert bool(density.isfinite().all())
    assert bool(raw.grad.isfinite().all())
    torch.testing.assert_close(density[1:4].detach(), raw.detach()[1:4].exp())
    torch.testing.assert_close(raw.grad[1:4], raw.detach()[1:4].exp())


def test_colours_have_the_slope_of_the_logistic_function_and_a_way_back_from_its_ends():
    raw = torch.tensor([[-90.0, -3.0, 0.0], [2.0, 60.0, 0.0]], requires_grad=True)
    color = color_from(raw, 0.003)
    slope = (color * (1 - color)).detach()
    torch.testing.assert_close(color.detach(), torch.sigmoid(raw.detach()))
    brighter, darker = (torch.autograd.grad(sign * color.sum(), raw, retain_graph=True)[0] for sign in (-1, 1))
    torch.testing.assert_close(brighter, -slope.where(raw > -90, 0.003))
    torch.testing.assert_close(darker, slope.where(raw < 60, 0.003))


@pytest.mark.parametrize("encoder", [FrequencyEncoder(3), HashGridEncoder(num_levels=2, log2_table_size=8)])
def test_features_that_are_known_give_the_same_result(encoder):
    field = NGPField(encoder, SphericalHarmonicsEncoder(2), width=8)
    positions = 2 * torch.rand(30, 3) - 1
    directions = torch.nn.functional.normalize(torch.randn(30, 3), dim=-1)
    with torch.no_grad():
        density, features = field.density(Points(positions))
    points = Points(positions, directions)
    whole, again = field(points), field(points, features)
    torch.testing.assert_close(density, whole.density)
    torch.testing.assert_close(again.rgb, whole.rgb)
    torch.testing.assert_close(again.density, whole.density)


def test_space_starts_thick_where_alpha_tells_what_is_empty_and_thin_where_nothing_does():
    """The fault: a dense start on a black background stays, as black fog."""
    scene = ball_scene()
    densities = []
    for given in (scene, without_alpha(scene)):
        field = a_field()
        torch.nn.init.zeros_(field.position_encoder.table)
        field.fit_to(given)
        densities.append(float(field.density(Points(torch.zeros(1, 3)))[0].detach()))
    assert densities[0] == pytest.approx(2.718281828**3, rel=1e-4)
    assert densities[1] == pytest.approx(2.718281828**-1, rel=1e-4)


SMALL = ("encoder.log2_table_size=10", "encoder.num_levels=3", "field.width=16")


def a_model(model="fast_small", appearance=4):
    found = build(composed("train", f"model={model}", *SMALL, f"field.appearance={appearance}").model)
    fit_parts(found, ball_scene(num_views=8))
    return found


def a_step(model):
    train_step = make_step(None, model)
    train_step.build_optimizer = lambda groups: torch.optim.Adam(groups, lr=1e-2)
    return train_step


@pytest.mark.parametrize("model", ["fast_small", "fast_proposal"])
def test_codes_learn_from_their_own_photographs_and_pictures_have_their_mean(model):
    scene, train_step = ball_scene(num_views=8), a_step(a_model(model))
    optimizer, loader = train_step.new_optimizer(), RayBatches(scene, train_step.progress, 0, 64)
    for _ in range(3):
        train_step(loader.batch_at(0, train_step.progress.rays_seen), optimizer)
    field, trained = train_step.objective.model.last.field, list(scene.splits["train"])
    codes = field.codes.detach()
    others = [view for view in range(8) if view not in trained]
    assert float(codes[trained].abs().amax(dim=1).min()) > 0
    assert float(codes[others].abs().max()) == 0
    points = Points(torch.rand(5, 3) - 0.5, torch.nn.functional.normalize(torch.randn(5, 3), dim=-1))
    neutral = field(points).rgb
    with torch.no_grad():
        codes[others[0]] = codes[trained].mean(dim=0)
    mean = field(replace(points, photograph=torch.full((5,), others[0]))).rgb
    torch.testing.assert_close(neutral, mean)
    assert not torch.allclose(field(replace(points, photograph=torch.full((5,), trained[0]))).rgb, mean)


def test_a_new_model_takes_the_codes_of_a_checkpoint():
    train_step = a_step(a_model())
    train_step(
        RayBatches(ball_scene(num_views=8), train_step.progress, 0, 64).batch_at(0, 0), train_step.new_optimizer()
    )
    again = build(composed("train", "model=fast_small", *SMALL, "field.appearance=4").model)
    model, rays = train_step.objective.model, train_step.objective.rays
    again.load_state_dict(model.state_dict())
    pictures = [render_picture(each.eval(), rays, 0, "white", 4096).rgb for each in (model, again)]
    assert torch.equal(*pictures)


def test_codes_of_no_view_and_one_photograph_are_refused():
    state = a_model().state_dict()
    state["levels.fine.field.trained"][0] = 8
    with pytest.raises(InputError, match="codes"):
        a_model().load_state_dict(state)
    scene = ball_scene(num_views=2)
    scene.splits["train"] = (0,)
    with pytest.raises(InputError, match=r"trains on one photograph.*field\.appearance=0"):
        fit_parts(build(composed("train", "model=fast_small", *SMALL, "field.appearance=4").model), scene)

from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene

from nerf_lightning.nerf.activations import color_from, density_from
from nerf_lightning.nerf.encoders.frequency import FrequencyEncoder
from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.encoders.spherical_harmonics import SphericalHarmonicsEncoder
from nerf_lightning.nerf.fields.ngp_field import NGPField
from nerf_lightning.nerf.types.points import Points


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


def test_a_little_colour_among_much_black_is_learnt():
    """The fault: all colours were 1e-38 after ten steps, with gradients as small, so a small thing was never seen."""
    field, positions = a_field(density_bias=-1.0), 2 * torch.rand(1000, 3) - 1
    field.fit_to(without_alpha(ball_scene()))
    small = (positions - 0.5).norm(dim=-1) < 0.3
    assert 10 < int(small.sum()) < 40
    color = torch.where(small[:, None], torch.tensor([0.4, 0.3, 0.2]), 0.0)
    directions = torch.nn.functional.normalize(torch.randn(1000, 3), dim=-1)
    optimizer = torch.optim.Adam(field.parameters(), lr=2e-2, betas=(0.9, 0.95), eps=1e-15)
    for _ in range(150):
        optimizer.zero_grad()
        rgb = field(Points(positions, directions)).rgb
        (rgb - color).square().mean().backward()
        optimizer.step()
    assert float((rgb - color).detach()[small].abs().mean()) < 0.05


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

from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene, some_rays, tiny_field

from nerf_lightning.nerf.models.dense_level import DenseLevel
from nerf_lightning.nerf.part import fit_parts
from nerf_lightning.nerf.randomness import batch_random
from nerf_lightning.nerf.rendering.background import background_colors, blend
from nerf_lightning.nerf.rendering.linear_light import KNEE, scale_light, to_linear
from nerf_lightning.nerf.rendering.near_gradients import soften_near_gradients
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler
from nerf_lightning.nerf.types.renderings import FieldOutput
from nerf_lightning.nerf.types.scene import UNSURE

CPU = torch.device("cpu")


def test_alpha_is_composited_exactly_once():
    """The faults: alpha never applied (red stays red) or applied twice (a quarter becomes a sixteenth)."""
    red = torch.tensor([1.0, 0.0, 0.0, 0.25])
    torch.testing.assert_close(blend(red, torch.ones(3)), torch.tensor([1.0, 0.75, 0.75]))
    torch.testing.assert_close(blend(red, torch.zeros(3)), torch.tensor([0.25, 0.0, 0.0]))


def test_without_a_background_colours_are_taken_as_they_are():
    rgba = torch.rand(5, 4)
    assert torch.equal(blend(rgba, None), rgba[:, :3])


def test_plain_backgrounds_and_none_that_closes_the_ray():
    for name, value in (("white", 1.0), ("black", 0.0)):
        assert torch.equal(background_colors(name, 3, CPU, None), torch.full((3, 3), value))
    assert background_colors("none", 3, CPU, batch_random(0, 3)) is None


def test_a_random_background_is_fresh_per_ray_and_white_at_evaluation():
    colours = background_colors("random", 500, CPU, batch_random(3, 500))
    assert colours.unique(dim=0).shape[0] == 500
    assert abs(float(colours.mean()) - 0.5) < 0.05
    assert torch.equal(background_colors("random", 2, CPU, None), torch.ones(2, 3))


@pytest.mark.parametrize(("name", "value"), [("white_or_random", 1.0), ("black_or_random", 0.0)])
def test_pixels_that_may_show_what_was_cut_out_keep_its_colour_behind_them(name, value):
    rgba, random = torch.rand(4, 4), batch_random(3, 4)
    rgba[:, 3] = torch.tensor([0, UNSURE - 1, UNSURE, 255]) / 255
    colours, drawn = background_colors(name, 4, CPU, random, rgba), background_colors("random", 4, CPU, random, rgba)
    assert (colours[2] == value).all()
    assert torch.equal(colours[[0, 1, 3]], drawn[[0, 1, 3]])
    assert torch.equal(background_colors(name, 4, CPU, None, rgba), torch.full((4, 3), value))


COLORS = torch.cat([torch.linspace(-0.5, 2.0, 1001), torch.tensor([0.0, KNEE])]).double()


@pytest.mark.parametrize("stops", [-8.0, -1.0, -0.01, 0.0, 0.01, 1.0, 8.0])
def test_it_is_to_decode_to_multiply_and_to_encode_again(stops):
    gain = torch.tensor(2.0**stops).double()
    light = gain * to_linear(COLORS)
    encoded = torch.where(light > KNEE / 12.92, 1.055 * light.abs() ** (1 / 2.4) - 0.055, 12.92 * light)
    torch.testing.assert_close(scale_light(COLORS, gain), encoded, atol=3e-7, rtol=1e-6)


def test_a_gain_of_one_changes_no_bit_of_colours_or_gradients():
    rgb = torch.cat([torch.rand(10_000) * 1.5 - 0.2, COLORS.float()]).requires_grad_()
    wanted = torch.randn(rgb.shape)
    scaled = scale_light(rgb, torch.exp2(torch.zeros_like(rgb)))
    assert torch.equal(scaled, rgb)
    scaled.backward(wanted)
    assert torch.equal(rgb.grad, wanted)


def test_gradients_are_right_and_finite_at_black_and_beyond():
    rgb = torch.tensor([-0.3, -1e-12, 0.0, 1e-12, 0.02, 0.3, 0.9, 1.0, 1.7]).double()[:, None].requires_grad_()
    gain = torch.tensor([0.05, 0.5, 1.0, 3.0, 40.0]).double()[None].requires_grad_()
    assert torch.autograd.gradcheck(lambda rgb, gain: scale_light(rgb.expand(9, 5), gain), (rgb, gain))


@pytest.mark.parametrize(("distance", "share"), [(0.0, 0.0), (0.5, 0.0625), (1.0, 0.25), (2.0, 1.0), (9.0, 1.0)])
def test_values_stay_and_gradients_fall_with_the_square_of_the_distance(distance, share):
    density, rgb = torch.tensor([[3.0]], requires_grad=True), torch.full((1, 1, 3), 0.4, requires_grad=True)
    seen = soften_near_gradients(FieldOutput(density, rgb), torch.tensor([[distance]]), whole_from=2.0)
    assert torch.equal(seen.density, density)
    assert torch.equal(seen.rgb, rgb)
    (2.0 * seen.density.sum() + 3.0 * seen.rgb.sum()).backward()
    assert density.grad.tolist() == [[2.0 * share]]
    torch.testing.assert_close(rgb.grad, torch.full((1, 1, 3), 3.0 * share))


@pytest.mark.parametrize("training", [True, False])
def test_a_level_softens_them_in_training_alone(training):
    field, rays = tiny_field(), some_rays(6)
    random = batch_random(0, 6) if training else None

    def gradient(whole_from):
        field.zero_grad()
        DenseLevel(StratifiedSampler(8), field, whole_from)(rays, None, [], random).rgb.sum().backward()
        return torch.cat([p.grad.flatten() for p in field.parameters()])

    whole = gradient(0.0)
    assert torch.equal(gradient(1e-6), whole)
    assert torch.equal(gradient(100.0), whole) != training


@pytest.mark.parametrize("ndc", [False, True])
def test_in_normalised_device_coordinates_no_distance_is_one(ndc):
    scene = ball_scene()
    scale = torch.ones(len(scene.cameras.c2w), 2) if ndc else None
    level = DenseLevel(StratifiedSampler(8), tiny_field(), 2.0)
    fit_parts(level, replace(scene, cameras=replace(scene.cameras, ndc=scale)))
    assert level.gradient_scaling_distance == (0.0 if ndc else 2.0)

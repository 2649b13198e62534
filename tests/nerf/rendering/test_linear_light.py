"""Light that is scaled behind the curve of a screen."""

import pytest
import torch

from nerf_lightning.nerf.rendering.linear_light import KNEE, scale_light, to_linear

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

"""What a camera makes of light: each part of it, against its meaning."""

import pytest
import torch
from support.configs import composed
from support.scenes import ball_scene

from nerf_lightning.config.instantiate import build
from nerf_lightning.nerf.rendering.linear_light import to_linear
from nerf_lightning.nerf.types.rays import PixelIndex

SIZE = 12


@pytest.fixture
def camera():
    made = build(composed("train", "correction=ppisp").correction)
    made.fit_to(ball_scene(size=SIZE))
    for parameter in made.parameters():
        parameter.requires_grad_(False)
    return made


def at(x, y):
    zero = torch.zeros(1, dtype=torch.int64)
    return PixelIndex(zero, zero + x, zero + y)


def test_exposure_is_in_stops_and_vignetting_grows_from_the_middle(camera):
    rgb = torch.tensor([[0.2, 0.4, 0.6]])
    camera.exposure[0] = -1.0
    torch.testing.assert_close(to_linear(camera(rgb, at(3, 3))), to_linear(rgb) / 2)
    camera.exposure[0] = 0.0
    camera.falloff[0, :, 0] = torch.tensor([-0.5, -0.5, 0.0])
    left, above = (float((to_linear(camera(rgb, at(*place))) / to_linear(rgb))[0, 0]) for place in ((0, 6), (6, 0)))
    expected = 1 - 0.5 * ((5.5 / SIZE) ** 2 + (0.5 / SIZE) ** 2)
    assert left == pytest.approx(expected, abs=1e-5)
    assert above == pytest.approx(expected, abs=1e-5)
    torch.testing.assert_close(camera(rgb, at(0, 0))[:, 2], rgb[:, 2])


def test_the_homography_moves_grey_where_it_says_and_keeps_the_intensity(camera):
    camera.chromaticity[0, 3] = torch.tensor([4.0, -2.0])
    gray, red = (to_linear(camera(torch.tensor([color]), at(3, 3))) for color in ([0.5] * 3, [0.5, 0.0, 0.0]))
    light = float(to_linear(torch.tensor(0.5)))
    expected = torch.tensor([[1 / 3 + 0.05, 1 / 3 - 0.025, 1 / 3 - 0.025]]) * 3 * light
    torch.testing.assert_close(gray, expected, atol=1e-4, rtol=0)
    torch.testing.assert_close(red, torch.tensor([[light, 0.0, 0.0]]), atol=1e-4, rtol=0)


def test_the_curve_keeps_black_and_white_and_rises(camera):
    camera.curve[0] = torch.tensor([1.5, -1.0, 0.5, -0.7])
    rgb = torch.linspace(0, 1, 50)[:, None].expand(50, 3)
    zero = torch.zeros(50, dtype=torch.int64)
    shown = camera(rgb, PixelIndex(zero, zero, zero))
    torch.testing.assert_close(shown[[0, -1]], rgb[[0, -1]], atol=1e-2, rtol=0)
    assert bool((shown.diff(dim=0) > 0).all())
    assert float((shown - rgb).abs().max()) > 0.05


def test_penalties_hold_the_means_the_middle_and_the_channels_together(camera):
    assert float(camera.penalty()) == 0.0
    for name in ("exposure", "chromaticity", "middle", "falloff", "curve"):
        parameter = getattr(camera, name)
        parameter[..., 0] = 0.5
        assert float(camera.penalty()) > 0 or name == "curve"
        parameter.zero_()
    camera.curve[0, 1, 0] = 0.5
    assert float(camera.penalty()) > 0
    camera.curve.zero_()
    camera.falloff[..., 0] = -0.5  # as lenses have it, alike in all channels
    assert float(camera.penalty()) == 0.0

"""Splats as bytes of a page: near to what they were, and small."""

from dataclasses import replace

import pytest
import torch
from support.some_splats import camera, some
from torch.nn.functional import normalize

from nerf_lightning.extensions.splats.quantized import COARSE, MOST_NATS, QuantizedSplats
from nerf_lightning.extensions.splats.rasterizer import rasterize


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_numbers_are_as_near_as_their_bytes_allow(degree):
    splats = some(500, degree)
    splats.means *= 10.0 ** torch.arange(-3, 2).repeat(100)[:, None]
    quantized = QuantizedSplats.of(splats)
    found = quantized.gaussians()
    assert quantized.content.shape == (20 + 3 * ((degree + 1) ** 2 - 1), 500)
    torch.testing.assert_close(found.means, splats.means, rtol=2.0**-16, atol=0)
    nats = quantized.scales[1] - quantized.scales[0]
    assert float((found.log_scales - splats.log_scales).abs().max()) <= nats / 509
    turned = normalize(found.quaternions, dim=-1) - normalize(splats.quaternions, dim=-1)
    assert float(turned.abs().max()) < 0.01
    assert float((found.opacity_logits.sigmoid() - splats.opacity_logits.sigmoid()).abs().max()) < 0.002
    assert found.sh_rest.shape == splats.sh_rest.shape
    if degree:
        clipped = splats.sh_rest.clamp(-quantized.harmonics, quantized.harmonics)
        assert float((found.sh_rest - clipped).abs().max()) <= 0.51 * COARSE * quantized.harmonics / 124


def test_the_picture_hardly_changes():
    splats, background = some(300, 2), torch.ones(3)
    expected = rasterize(splats, camera(), background)
    found = rasterize(QuantizedSplats.of(splats).gaussians(), camera(), background)
    assert float((found - expected).square().mean()) < 1e-4


def test_sizes_of_nothing_do_not_coarsen_the_others():
    splats = some(50)
    splats.log_scales[0, 0] = -1e4
    low, high = QuantizedSplats.of(splats).scales
    assert high - low == pytest.approx(MOST_NATS)
    same = replace(splats, log_scales=torch.full_like(splats.log_scales, -2.0))
    assert torch.equal(QuantizedSplats.of(same).gaussians().log_scales, same.log_scales)

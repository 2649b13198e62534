"""The hybrid encoder: its factor against a slow reference, that nothing is computed twice, and cones at every level."""

from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene, some_rays
from torch import nn

from nerf_lightning.extensions.hybrid.encoder import CONE_OCTAVES, HybridEncoder
from nerf_lightning.nerf.encoders.frequency import FrequencyEncoder
from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.encoders.spherical_harmonics import SphericalHarmonicsEncoder
from nerf_lightning.nerf.fields.ngp_field import NGPField
from nerf_lightning.nerf.models.dense_level import DenseLevel
from nerf_lightning.nerf.models.masked_level import MaskedLevel
from nerf_lightning.nerf.models.ragged_level import RaggedLevel
from nerf_lightning.nerf.part import fit_parts
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler

CONE = torch.tensor([3.0, 2.0, 1.0, 0.5, -0.4, 0.3]) * 1e-3


def an_encoder(**settings):
    torch.manual_seed(4)
    grid = HashGridEncoder(num_levels=2, features_per_level=3, log2_table_size=9, max_resolution=40)
    encoder = HybridEncoder(FrequencyEncoder(3, include_input=False), grid, **({"width": 8} | settings))
    nn.init.normal_(grid.table)
    return encoder


@pytest.mark.parametrize("cones", [False, True])
def test_the_factor_is_what_one_point_after_the_other_gives(cones):
    encoder, points = an_encoder(cones=cones).double(), torch.rand(5, 3).double()
    covariance = CONE.double() * torch.rand(5, 6).double()
    found = encoder(points, covariance) if cones else encoder(points)
    for number, point in enumerate(points):
        fine = encoder.fine(point)
        seen = fine.tolist()
        for three in (covariance[number, :3], covariance[number, 3:]) if cones else ():
            cells = [float(entry) * 40.0**2 for entry in three]
            cells = torch.tensor([entry / (1.0 + abs(entry)) for entry in cells]).double()
            for octave in range(CONE_OCTAVES):
                seen += [*(2**octave * cells).sin().tolist(), *(2**octave * cells).cos().tolist()]
        first, second, last = encoder.factor_mlp
        hidden = (second @ (first @ torch.tensor(seen).double()).clamp(min=0)).clamp(min=0)
        expected = torch.cat([torch.tanh(last @ hidden) * encoder.coarse(point), fine])
        torch.testing.assert_close(found[number], expected)


@pytest.mark.parametrize("settings", [{}, {"cones": True}, {"factor": "one"}])
def test_known_features_have_the_gradients_of_computed_ones(settings):
    encoder, points = an_encoder(**settings), torch.rand(50, 3)
    given = (CONE.expand(50, 6),) if encoder.sees_cones else ()
    known, grad = encoder(points, *given).detach(), torch.randn(50, encoder.out_dim)
    results = []
    for features in (encoder(points, *given), encoder.attach_gradients(points, known, *given)):
        encoder.zero_grad()
        features.backward(grad)
        results.append([features.detach(), *(weight.grad.clone() for weight in encoder.parameters())])
    assert all(torch.equal(found, expected) for found, expected in zip(*results, strict=True))


@pytest.mark.parametrize("kind", [RaggedLevel, MaskedLevel, DenseLevel])
def test_every_level_tells_the_factor_of_the_cones(kind):
    field = NGPField(an_encoder(cones=True), SphericalHarmonicsEncoder(2), width=16, density_bias=0.0)
    sampler = StratifiedSampler(12) if kind is DenseLevel else OccupancySampler(resolution=8, num_steps=64)
    level = kind(sampler, field).eval()
    fit_parts(level, ball_scene(num_views=12))
    rays = replace(some_rays(40), pixel_side=torch.tensor([0.0, 0.02]).expand(40, 2))
    wide, thin = (level(replace(rays, pixel_side=size * rays.pixel_side), None, [], None).rgb for size in (1.0, 0.1))
    assert float((wide - thin).detach().abs().max()) > 5e-5


@pytest.mark.parametrize("settings", [{"factor": "one", "cones": True}, {"width": 0}])
def test_settings_that_do_not_fit_are_refused(settings):
    with pytest.raises(ValueError, match=next(reversed(settings))):
        an_encoder(**settings)

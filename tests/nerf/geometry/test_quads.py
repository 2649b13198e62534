"""Pictures by quads: every pixel once, those of a quad beside each other, and proposals that are shared."""

from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene

from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.encoders.spherical_harmonics import SphericalHarmonicsEncoder
from nerf_lightning.nerf.fields.ngp_field import NGPField
from nerf_lightning.nerf.geometry.cameras import all_pixels, pinhole_cameras
from nerf_lightning.nerf.geometry.quads import QUAD, from_quads, pixels_in_quads, quads_between
from nerf_lightning.nerf.models.dense_level import DenseLevel
from nerf_lightning.nerf.models.proposal_level import ProposalLevel
from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import render_picture, render_rays
from nerf_lightning.nerf.samplers.proposal import ProposalSampler
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler


@pytest.mark.parametrize(("width", "height"), [(1, 1), (2, 2), (5, 3), (4, 7)])
def test_quads_are_pixels_that_touch_and_the_picture_is_theirs(width, height):
    cameras = pinhole_cameras(torch.eye(4)[:3][None], 10.0, width, height)
    count = pixels_in_quads(height, width)
    pixels = quads_between(cameras, 0, slice(0, count))
    assert pixels.view.shape == (count,)
    for column in (pixels.x, pixels.y):
        quads = column.view(-1, QUAD)
        assert int((quads.amax(dim=1) - quads.amin(dim=1)).max()) <= 1
    whole = all_pixels(cameras, 0)
    assert torch.equal(from_quads(pixels.x.float(), height, width), whole.x.float())
    assert torch.equal(from_quads(pixels.y.float(), height, width), whole.y.float())
    part = quads_between(cameras, 0, slice(count - 3, count))
    assert torch.equal(part.x, pixels.x[-3:])


def proposing_model(cells):
    torch.manual_seed(2)

    def field(resolution):
        encoder = HashGridEncoder(2, 2, log2_table_size=12, min_resolution=2, max_resolution=resolution)
        torch.nn.init.uniform_(encoder.table, -1.0, 1.0)
        return NGPField(encoder, SphericalHarmonicsEncoder(2), width=16, density_bias=1.0)

    samplers = [StratifiedSampler(16), StratifiedSampler(16), ProposalSampler(12)]
    proposals = [ProposalLevel(sampler, field(cells)) for sampler in samplers[:2]]
    return RadianceModel({"first": proposals[0], "second": proposals[1], "fine": DenseLevel(samplers[2], field(64))})


@torch.no_grad()
def test_rays_of_a_quad_share_proposals_and_their_picture_is_nearly_that_of_each_ray_alone():
    scene, asked = ball_scene(size=60), []
    model = proposing_model(cells=4).eval()
    for level in model.levels.values():
        level.sampler.register_forward_pre_hook(lambda _, given: asked.append(len(given[0].near)))
    generator = RayGenerator(scene.cameras, scene.near, scene.far)
    rays = generator(quads_between(scene.cameras, 0, slice(0, 3600)))
    alone = render_rays(model, rays, "white", 1 << 20).rgb
    asked.clear()
    shared = render_rays(model, replace(rays, together=QUAD), "white", 1 << 20).rgb
    assert sum(asked) == 3 * 3600 + 2 * 900  # of all rays only where their samples lie
    order = torch.randperm(3600)
    strangers = render_rays(model, replace(rays[order], together=QUAD), "white", 1 << 20).rgb
    among_strangers = float((strangers - alone[order]).abs().mean())
    assert 0.0 < float((shared - alone).abs().mean()) < 0.5 * among_strangers
    picture = render_picture(model, generator, 0, "white", 1 << 20).rgb
    torch.testing.assert_close(picture, from_quads(shared, 60, 60), rtol=0, atol=1e-6)

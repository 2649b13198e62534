"""The gradient of a packed picture by its camera: kernels, features that are kept and samples that are dropped."""

import copy
from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene

from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.encoders.spherical_harmonics import SphericalHarmonicsEncoder
from nerf_lightning.nerf.fields.ngp_field import NGPField
from nerf_lightning.nerf.geometry.cameras import all_pixels
from nerf_lightning.nerf.models.ragged_level import RaggedLevel
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.part import StepContext
from nerf_lightning.nerf.randomness import batch_random
from nerf_lightning.nerf.refinements.se3 import SE3Delta
from nerf_lightning.nerf.rendering.ragged import composite_ragged
from nerf_lightning.nerf.rendering.sample_points import ragged_points
from nerf_lightning.nerf.samplers.early_termination import visible_samples
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler


@pytest.mark.parametrize("blended", [1.0, 0.5])
def test_a_camera_before_packed_samples_has_the_gradient_of_the_reference_in_float64(blended):
    torch.manual_seed(0)
    scene = replace(ball_scene(), refined=True)
    encoder = HashGridEncoder(
        num_levels=3, log2_table_size=10, min_resolution=4, max_resolution=16, blend_in=0.0 if blended == 1.0 else 0.5
    )
    field = NGPField(encoder, SphericalHarmonicsEncoder(3), width=16)
    level = RaggedLevel(OccupancySampler(resolution=8, num_steps=32, opaque_below=0.1), field)
    level.sampler.fit_to(scene)
    field.fit_to(scene)
    torch.nn.init.normal_(encoder.table, std=0.3)
    encoder.on_step(StepContext(0.5 * blended, 0, 0))
    motion = SE3Delta()
    motion.fit_to(scene)
    rays = RayGenerator(scene.cameras, scene.near, scene.far, motion)
    pixels = all_pixels(scene.cameras, 1).map(torch.Tensor.flatten)
    random = batch_random(7, pixels.x.shape[0], torch.device("cpu"))
    weight = torch.rand(pixels.x.shape[0], 3)

    (weight * level(rays(pixels), None, [], random).rgb).sum().backward()

    exact_rays, exact_field = copy.deepcopy(rays).double(), copy.deepcopy(field).double()
    exact_rays.zero_grad()
    samples, features = visible_samples(level.sampler, level.field, rays(pixels), random)
    assert features is not None
    samples = replace(samples, starts=samples.starts.double(), ends=samples.ends.double())
    bundle = exact_rays(pixels)
    output = exact_field(ragged_points(bundle, samples, None))
    output = replace(output, density=output.density.double(), rgb=output.rgb.double())
    (weight * composite_ragged(output, samples, bundle, None).rgb).sum().backward()
    for found, exact in zip(rays.parameters(), exact_rays.parameters(), strict=True):
        assert float(exact.grad[1].abs().min()) > 1e-3
        torch.testing.assert_close(found.grad.double(), exact.grad, rtol=1e-3, atol=1e-4)

"""Gradients of a picture with respect to a camera, through hash grid and MLPs, are those of finite differences."""

import torch
from support.scenes import ball_scene

from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.encoders.spherical_harmonics import SphericalHarmonicsEncoder
from nerf_lightning.nerf.fields.ngp_field import NGPField
from nerf_lightning.nerf.models.dense_level import DenseLevel
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.refinements.se3 import SE3Delta
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler
from nerf_lightning.nerf.types.rays import PixelIndex

STEP = 1e-3


def test_a_camera_has_the_gradients_of_finite_differences():
    torch.manual_seed(0)
    scene = ball_scene(size=16)
    encoder = HashGridEncoder(num_levels=2, log2_table_size=12, min_resolution=4, max_resolution=6)
    # Contracted, so that no ray has an end that moves with it.
    field = NGPField(encoder, SphericalHarmonicsEncoder(3), width=16, density_bias=0.5, contraction=True)
    torch.nn.init.normal_(encoder.table, std=0.5)
    level, refinement = DenseLevel(StratifiedSampler(48), field), SE3Delta()
    refinement.fit_to(scene)
    rays = RayGenerator(scene.cameras, scene.near, scene.far, refinement)
    y, x = torch.meshgrid(torch.arange(16), torch.arange(16), indexing="ij")
    pixels = PixelIndex(torch.zeros(256, dtype=torch.int64), x.flatten(), y.flatten())
    weight = torch.rand(256, 3)

    def loss():
        return (weight * level(rays(pixels), torch.ones(256, 3), [], None).rgb).mean()

    loss().backward()
    for parameter in (refinement.rotation, refinement.shift):
        for axis in range(3):
            ends = []
            for step in (STEP, -2 * STEP):
                with torch.no_grad():
                    parameter[0, axis] += step
                    ends.append(float(loss()))
            with torch.no_grad():
                parameter[0, axis] += STEP
            slope = (ends[0] - ends[1]) / (2 * STEP)
            assert abs(float(parameter.grad[0, axis]) - slope) < 6e-5 + 0.03 * abs(slope), (axis, slope)

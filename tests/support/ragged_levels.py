"""A small level behind an occupancy grid, which kernels for whole rays take."""

import pytest
import torch
from support.scenes import ball_scene

from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.encoders.spherical_harmonics import SphericalHarmonicsEncoder
from nerf_lightning.nerf.fields.ngp_field import NGPField
from nerf_lightning.nerf.matmul_precision import cpu_multiplies_bfloat16, set_precision
from nerf_lightning.nerf.models.ragged_level import RaggedLevel
from nerf_lightning.nerf.part import fit_parts
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler

needs_bfloat16 = pytest.mark.skipif(
    not cpu_multiplies_bfloat16(), reason="this CPU, as far as torch may use it, does not multiply bfloat16 itself"
)


def a_level(opaque_below=0.0, width=32, features=4, matmul_precision="float32", **settings):
    torch.manual_seed(1)
    grid = HashGridEncoder(num_levels=16 // features, features_per_level=features, log2_table_size=8, max_resolution=32)
    torch.nn.init.uniform_(grid.table, -1.0, 1.0)
    field = NGPField(grid, SphericalHarmonicsEncoder(4), width=width, **settings)
    sampler = OccupancySampler(resolution=32, num_steps=100, opaque_below=opaque_below)
    level = RaggedLevel(sampler, field)
    fit_parts(level, ball_scene(num_views=12))
    set_precision(field, matmul_precision)
    sampler.grid.occupy(torch.rand(sampler.grid.cells.shape) < 0.05)
    return level

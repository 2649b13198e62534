"""Density and color at the corners of a grid over the scene's box, and no network (after arXiv 2111.11215)."""

import torch
from torch import nn
from torch.nn.functional import grid_sample, softplus

from nerf_lightning.nerf.geometry.boxes import to_unit_cube
from nerf_lightning.nerf.models.base import PointField
from nerf_lightning.nerf.rendering.quadrature import composite
from nerf_lightning.nerf.rendering.sample_points import points_along
from nerf_lightning.nerf.samplers.base import DenseSampler
from nerf_lightning.nerf.types.rays import Points
from nerf_lightning.nerf.types.renderings import FieldOutput


class VoxelModel(PointField):
    """A grid over the scene's box.

    Args:
        sampler: where it is looked up along a ray.
        resolution: corners along each side of the box.
    """

    def __init__(self, sampler: DenseSampler, resolution: int = 32):
        super().__init__()
        self.sampler = sampler
        self.grid = nn.Parameter(torch.zeros(1, 4, resolution, resolution, resolution))
        self.register_buffer("aabb", torch.tensor([[-1.0] * 3, [1.0] * 3]))

    @property
    def level_names(self):
        return ("grid",)

    def fit_to(self, scene):
        self.aabb.copy_(scene.aabb)

    def forward(self, rays, background, random):
        samples = self.sampler(rays, [], random)
        return [composite(self.query(points_along(rays, samples, random)), samples, rays, background)]

    def query(self, points):
        cube = 2.0 * to_unit_cube(points.positions, self.aabb) - 1.0
        found = grid_sample(self.grid, cube.reshape(1, 1, 1, -1, 3), align_corners=True)
        found = found.reshape(4, *cube.shape[:-1])
        inside = (cube.abs() <= 1.0).all(dim=-1)
        return FieldOutput(density=inside * softplus(found[0]), rgb=found[1:].sigmoid().movedim(0, -1))

    def density(self, positions):
        return self.query(Points(positions)).density

    def points_per_ray(self, training):
        return float(self.sampler.num_samples_after(0))

    def reset_parameters(self):
        nn.init.normal_(self.grid, std=0.1)

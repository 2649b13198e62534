"""A level that masks what an occupancy grid rules out instead of skipping it, so that all shapes are static."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.kernels.march.reference import occupied_intervals
from nerf_lightning.nerf.models.level import Level
from nerf_lightning.nerf.part import StepContext
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.rendering.quadrature import composite
from nerf_lightning.nerf.rendering.sample_points import points_along
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler
from nerf_lightning.nerf.types.rays import RayBundle, RaySamples
from nerf_lightning.nerf.types.renderings import DenseRendering, Rendering


class MaskedLevel(Level):
    """Evaluate the field in every interval of a ray, and set the density of empty cells to 0.

    It renders the same as `RaggedLevel`, up to the light left behind opaque samples. It computes several times as many
    samples, and is for compilers that need static shapes (XLA).
    """

    sampler: OccupancySampler
    sampler_kind = OccupancySampler
    replays = False

    def on_step(self, context: StepContext) -> None:
        """Let the sampler learn from the field."""
        self.sampler.learn(self.field_density, context.step, context.key)

    def points_per_ray(self, before: float, training: bool) -> float:
        """Return the number of intervals of the lattice."""
        return float(self.sampler.lattice.numel() - 2)

    def forward(
        self,
        rays: RayBundle,
        background: Float[Tensor, "rays 3"] | None,
        history: list[Rendering],
        random: RayRandom | None,
    ) -> DenseRendering:
        """Render rays; without a background they are open in front of black, as with `RaggedLevel`."""
        state = self.sampler.start(rays, random)
        lattice = self.sampler.lattice if random is not None else self.sampler.lattice_over(rays)
        occupied, edges = occupied_intervals(rays, state, lattice, self.sampler.grid.occupied())
        samples = RaySamples(edges)
        output = self.field(points_along(rays, samples, random, self.field.sees_cones))
        masked = replace(output, density=torch.where(occupied, output.density, 0.0))
        return composite(masked, samples, rays, torch.zeros_like(rays.origins) if background is None else background)

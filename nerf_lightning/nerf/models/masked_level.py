"""A level that masks what an occupancy grid rules out instead of leaving it out: every shape is known beforehand."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.kernels.march.reference import occupied_intervals
from nerf_lightning.nerf.models.occupancy_level import GridLevel
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.rendering.quadrature import composite
from nerf_lightning.nerf.types.rays import RayBundle, RaySamples
from nerf_lightning.nerf.types.renderings import DenseRendering, FieldOutput, Rendering


class MaskedLevel(GridLevel):
    """Ask the field in every interval of a ray, and let empty cells have no density.

    It renders what `PackedLevel` renders, up to the light that is left behind samples which are opaque. It computes
    several times as many samples, and is for compilers that need static shapes (XLA).
    """

    def points_per_ray(self, before: float, training: bool) -> float:
        """All intervals of the lattice."""
        return float(self.sampler.lattice.numel() - 2)

    def update(self, step: int, key: int) -> None:
        """Bring the grid up to date, where it is time."""
        self.sampler.update(self.field.density, step, key)

    def statistics(self) -> dict[str, float]:
        """Return the share of cells that are occupied."""
        return {"train/occupied": float(self.sampler.cells.cpu().float().mean())}

    def forward(
        self,
        rays: RayBundle,
        background: Float[Tensor, "rays 3"] | None,
        history: list[Rendering],
        random: RayRandom | None,
    ) -> DenseRendering:
        """Render rays; without a background they are open in front of black, as those of `PackedLevel` are."""
        state = self.sampler.start(rays, random)
        lattice = self.sampler.lattice if random is not None else self.sampler.lattice_over(rays)
        occupied, edges = occupied_intervals(rays, state, lattice, self.sampler.grid)
        samples = RaySamples(edges)
        along = samples.midpoints[..., None] * rays.directions[:, None]
        output = self.field(rays.origins[:, None] + along, rays.view_directions[:, None], random)
        masked = FieldOutput(density=torch.where(occupied, output.density, 0.0), rgb=output.rgb)
        return composite(masked, samples, rays, torch.zeros_like(rays.origins) if background is None else background)

"""A level that masks what an occupancy grid rules out instead of leaving it out: every shape is known beforehand."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.fields.base import Field
from nerf_lightning.kernels.march_torch import occupied_intervals
from nerf_lightning.models.levels import AnyLevel
from nerf_lightning.randomness import RayRandom
from nerf_lightning.rendering.quadrature import composite
from nerf_lightning.samplers.occupancy import OccupancySampler
from nerf_lightning.types import DenseRendering, FieldOutput, RayBundle, RaySamples, Rendering, Scene


class MaskedLevel(AnyLevel):
    """Ask the field in every interval of a ray, and let empty cells have no density.

    It renders what `PackedLevel` renders, up to the light that is left behind samples which are opaque. It computes
    several times as many samples, and is for compilers that need static shapes (XLA).
    """

    def __init__(self, sampler: OccupancySampler, field: Field):
        super().__init__()
        self.sampler: OccupancySampler = sampler
        self.field = field

    def points_per_ray(self, before: float, training: bool) -> float:
        """All intervals of the lattice."""
        return float(self.sampler.lattice.numel() - 2)

    def place(self, scene: Scene) -> None:
        """Hand the scene's box to the field, and all of it to the sampler."""
        super().place(scene)
        self.sampler.place(scene)

    def density(self, positions: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        """Return the density in the cells where rays look for it."""
        return self.sampler.density_in_cells(self.field.density, positions)

    def reset_parameters(self) -> None:
        """Draw the field anew and empty the grid."""
        super().reset_parameters()
        self.sampler.reset()

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
        occupied, edges = occupied_intervals(rays, state, self.sampler.lattice, self.sampler.grid)
        samples = RaySamples(edges)
        along = samples.midpoints[..., None] * rays.directions[:, None]
        output = self.field(rays.origins[:, None] + along, rays.view_directions[:, None], random)
        masked = FieldOutput(density=torch.where(occupied, output.density, 0.0), rgb=output.rgb)
        return composite(masked, samples, rays, torch.zeros_like(rays.origins) if background is None else background)

"""What levels with an occupancy grid share: the sampler's grid says where the field has any density at all."""

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.models.base import Level
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler


class GridLevel(Level):
    """The contract of a level that computes only what an occupancy grid does not rule out."""

    sampler: OccupancySampler
    sampler_kind = OccupancySampler

    def density(self, positions: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        """Return the density in the cells where rays look for it."""
        return self.sampler.density_in_cells(self.field.density, positions)

    def reset_parameters(self) -> None:
        """Draw the field anew, empty the grid, and forget what was counted."""
        super().reset_parameters()
        self.sampler.reset()
        self.forget_measurements()

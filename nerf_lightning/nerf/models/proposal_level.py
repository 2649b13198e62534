"""A level that only proposes where to look: density without colour."""

from nerf_lightning.nerf.models.dense_level import DenseLevel
from nerf_lightning.nerf.types.points import Points
from nerf_lightning.nerf.types.renderings import FieldOutput


class ProposalLevel(DenseLevel):
    """Sample, ask the field for density alone, and hand the weights on; its picture is black."""

    has_color = False

    def look(self, points: Points) -> FieldOutput:
        """Return the density, and black."""
        density, _ = self.field.density(points)
        return FieldOutput(density, density.new_zeros(*density.shape, 3))

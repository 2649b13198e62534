"""A level that only proposes where to look: density without colour."""

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.models.dense_level import DenseLevel
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.types.renderings import FieldOutput


class ProposalLevel(DenseLevel):
    """Sample, ask the field for density alone, and hand the weights on; its picture is black."""

    has_color = False

    def field_output(
        self,
        positions: Float[Tensor, "*rays samples 3"],
        directions: Float[Tensor, "*rays 1 3"],
        random: RayRandom | None,
    ) -> FieldOutput:
        """Return the density, and black."""
        density = self.field.density(positions)
        return FieldOutput(density, density.new_zeros(*density.shape, 3))

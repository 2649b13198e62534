"""A level that only proposes where to look: density without colour."""

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.models.levels import Level
from nerf_lightning.randomness import RayRandom
from nerf_lightning.rendering.quadrature import composite
from nerf_lightning.types import DenseRendering, FieldOutput, RayBundle


class ProposalLevel(Level):
    """Sample, ask the field for density alone, and hand the weights on; its picture is black."""

    def forward(
        self,
        rays: RayBundle,
        background: Float[Tensor, "*rays 3"] | None,
        history: list[DenseRendering],
        random: RayRandom | None,
    ) -> DenseRendering:
        """Return weights and depth."""
        samples = self.sampler(rays, history, random)
        along = samples.midpoints[..., None] * rays.directions[..., None, :]
        density = self.field.density(rays.origins[..., None, :] + along)
        return composite(FieldOutput(density, density.new_zeros(*density.shape, 3)), samples, rays, background)

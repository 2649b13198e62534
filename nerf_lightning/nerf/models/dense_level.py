"""A level in which every ray has the same number of samples, as in the original NeRF."""

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.models.level import Level
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.rendering.quadrature import composite
from nerf_lightning.nerf.rendering.sample_points import points_along
from nerf_lightning.nerf.samplers.base import DenseSampler
from nerf_lightning.nerf.types.points import Points
from nerf_lightning.nerf.types.rays import RayBundle
from nerf_lightning.nerf.types.renderings import DenseRendering, FieldOutput


class DenseLevel(Level):
    """A level in which every ray has the same number of samples."""

    sampler: DenseSampler
    sampler_kind = DenseSampler

    def points_per_ray(self, before: float, training: bool) -> float:
        """As the sampler says."""
        return float(self.sampler.num_samples_after(int(before)))

    def compile_field(self) -> bool:
        """Compile the field, for static shapes: dynamic ones may be specialised otherwise after a resume."""
        if self.field.compiles:
            self.field.compile(dynamic=False)
        return self.field.compiles

    def forward(
        self,
        rays: RayBundle,
        background: Float[Tensor, "*rays 3"] | None,
        history: list[DenseRendering],
        random: RayRandom | None,
    ) -> DenseRendering:
        """Sample, ask the field at the midpoints, composite."""
        samples = self.sampler(rays, history, random)
        return composite(self.look(points_along(rays, samples, random)), samples, rays, background)

    def look(self, points: Points) -> FieldOutput:
        """Return what the field says of the samples."""
        return self.field(points)

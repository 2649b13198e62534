"""A method as named levels of (sampler, field): each level samples where the one before saw something."""

from typing import cast

from jaxtyping import Float
from torch import Tensor, nn

from nerf_lightning.fields.base import Field
from nerf_lightning.randomness import RayRandom
from nerf_lightning.rendering.quadrature import composite
from nerf_lightning.samplers.base import Sampler
from nerf_lightning.types import RayBundle, Rendering


class Level(nn.Module):
    """One round of sampling and rendering."""

    def __init__(self, sampler: Sampler, field: Field):
        super().__init__()
        self.sampler = sampler
        self.field = field

    def forward(
        self,
        rays: RayBundle,
        background: Float[Tensor, "*rays 3"] | None,
        history: list[Rendering],
        random: RayRandom | None,
    ) -> Rendering:
        """Sample, ask the field at the midpoints, composite."""
        samples = self.sampler(rays, history, random)
        along = samples.midpoints[..., None] * rays.directions[..., None, :]
        output = self.field(rays.origins[..., None, :] + along, rays.directions[..., None, :], random)
        return composite(output, samples, rays, background)


class RadianceModel(nn.Module):
    """The original NeRF is two levels, coarse (stratified) and fine (importance); the last one is the picture.

    Args:
        levels: name -> level, in order.
    """

    max_samples: int
    """The largest number of points that one ray takes in any level: what tiles are cut by."""

    def __init__(self, levels: dict[str, Level]):
        super().__init__()
        self.levels = nn.ModuleDict(levels)
        counts = [0]
        for level in self._in_order():
            counts.append(level.sampler.num_samples_after(counts[-1]))
        self.max_samples = max(counts)

    @property
    def level_names(self) -> tuple[str, ...]:
        """The levels' names, first to last."""
        return tuple(self.levels)

    @property
    def needs_whole_batch(self) -> bool:
        """Whether any field forbids tiles."""
        return any(level.field.needs_whole_batch for level in self._in_order())

    def forward(
        self,
        rays: RayBundle,
        background: Float[Tensor, "*rays 3"] | None,
        random: RayRandom | None,
    ) -> list[Rendering]:
        """Render rays, first level first.

        Args:
            rays: unit directions, scene units.
            background: colour behind each ray; None closes the ray.
            random: the step's numbers for these rays; None for evaluation.
        """
        history: list[Rendering] = []
        for level in self._in_order():
            history.append(level(rays, background, history, random))
        return history

    def reset_parameters(self) -> None:
        """Draw every parameter anew from torch's generator."""
        for level in self._in_order():
            level.field.reset_parameters()

    def _in_order(self) -> list[Level]:
        return cast(list[Level], list(self.levels.values()))

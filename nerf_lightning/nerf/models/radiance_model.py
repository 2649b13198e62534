"""A method as named levels of (sampler, field): each level samples where the previous one saw something."""

from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerf_lightning.nerf.geometry.contraction import Contracted
from nerf_lightning.nerf.models.base import PointField
from nerf_lightning.nerf.models.level import Level
from nerf_lightning.nerf.models.ray_generator import Subpixels
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.types.rays import Points, RayBundle
from nerf_lightning.nerf.types.renderings import FieldOutput, Rendering


class RadianceModel(PointField):
    """Levels, the last of which is the picture. The original NeRF has two: coarse (stratified) and fine (importance).

    Args:
        levels: name -> level, in order.
        subpixels: rays along each side of a pixel, whose mean is compared with the photograph in the last part of the
            run and in renders; 1: one ray through the center.
        subpixels_from: share of the run at which that part begins.
    """

    def __init__(self, levels: dict[str, Level], subpixels: int = 1, subpixels_from: float = 0.8):
        super().__init__()
        self.subpixels = Subpixels(subpixels, subpixels_from)
        self.levels = nn.ModuleDict(levels)
        # Incompatible levels are refused here; without memory (`meta`) a lattice cannot be counted.
        if not any(buffer.is_meta for buffer in self.buffers()):
            self.points_per_ray(training=False)

    @property
    def level_names(self) -> tuple[str, ...]:
        """The levels' names, first to last."""
        return tuple(self.levels)

    @property
    def first_picture(self) -> int | None:
        """The index of the first level whose rendering is a picture, if it is not the last one."""
        numbers = [number for number, level in enumerate(self._in_order()) if level.has_color]
        return numbers[0] if len(numbers) > 1 else None

    @property
    def has_static_shapes(self) -> bool:  # type: ignore[override]
        """Whether no level has data-dependent shapes."""
        return all(level.has_static_shapes for level in self._in_order())

    def takes_whole_rays(self, device: torch.device, training: bool, learns_cameras: bool = False) -> bool:
        """Return whether every level does."""
        return all(level.takes_whole_rays(device, training, learns_cameras) for level in self._in_order())

    def points_per_ray(self, training: bool) -> float:
        """Return the largest number of points that a ray sends through any field at once: it determines the tiles."""
        counts = [0.0]
        for level in self._in_order():
            counts.append(level.points_per_ray(counts[-1], training))
        return max(counts)

    @property
    def last(self) -> Level:
        """The level whose picture counts."""
        return self._in_order()[-1]

    def density(self, positions: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        """Return the density per unit length, as rays of the last level find it."""
        return self.last.density(positions)

    def query(self, points: Points) -> FieldOutput:
        """Return density and color at points, from the last level's field."""
        return self.last.field(points)

    def forward(
        self,
        rays: RayBundle,
        background: Float[Tensor, "*rays 3"] | None,
        random: RayRandom | None,
    ) -> list[Rendering]:
        """Render rays, first level first.

        Args:
            rays: unit directions, scene units.
            background: color behind each ray; None closes the ray.
            random: the step's numbers for these rays; None for evaluation.
        """
        history: list[Rendering] = []
        for level in self._in_order():
            history.append(level(rays, background, history, random))
        return history

    def kernels(self) -> tuple[str, ...]:
        """Return the kernels of the levels whose fields they support."""
        return tuple(name for level in self._in_order() if level.field.parts() is not None for name in level.kernels)

    def compile_fields(self) -> list[str]:
        """Compile the fields of levels with static shapes (torch.compile), and return the levels' names."""
        for module in self.modules():
            if isinstance(module, Contracted):
                module.is_on()  # reading its buffer in a compiled field would break the graph
        return [name for name, level in zip(self.levels, self._in_order(), strict=True) if level.compile_field()]

    def rounds(self) -> dict[str, nn.Module]:
        """Return the levels."""
        return dict(self.levels.items())

    def _in_order(self) -> list[Level]:
        return cast(list[Level], list(self.levels.values()))

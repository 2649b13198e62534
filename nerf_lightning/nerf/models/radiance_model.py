"""A method as named levels of (sampler, field): each level samples where the one before saw something."""

from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerf_lightning.nerf.geometry.contraction import Contracted
from nerf_lightning.nerf.matmul_precision import MatmulPrecision
from nerf_lightning.nerf.models.base import PointField, norm_of_gradients
from nerf_lightning.nerf.models.level import Level
from nerf_lightning.nerf.models.subpixels import Subpixels
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.types.points import Points
from nerf_lightning.nerf.types.rays import RayBundle
from nerf_lightning.nerf.types.renderings import FieldOutput, Rendering
from nerf_lightning.nerf.types.scene import Scene


class RadianceModel(PointField):
    """The original NeRF is two levels, coarse (stratified) and fine (importance); the last one is the picture.

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
        # Levels that do not fit each other are refused here; without memory (`meta`) a lattice cannot be counted.
        if not any(buffer.is_meta for buffer in self.buffers()):
            self.points_per_ray(training=False)

    @property
    def level_names(self) -> tuple[str, ...]:
        """The levels' names, first to last."""
        return tuple(self.levels)

    @property
    def first_picture(self) -> int | None:
        """The number of the first level whose rendering is a picture, where it is not the last one."""
        numbers = [number for number, level in enumerate(self._in_order()) if level.has_color]
        return numbers[0] if len(numbers) > 1 else None

    @property
    def has_static_shapes(self) -> bool:  # type: ignore[override]
        """Whether no level's shapes depend on what it finds."""
        return all(level.has_static_shapes for level in self._in_order())

    @property
    def replays(self) -> bool:  # type: ignore[override]
        """Whether every level does."""
        return all(level.replays for level in self._in_order())

    @property
    def step_variant(self) -> tuple[Any, ...]:  # type: ignore[override]
        """Those of all levels."""
        return tuple(level.step_variant for level in self._in_order())

    def takes_whole_rays(self, device: torch.device, training: bool, learns_cameras: bool = False) -> bool:
        """Return whether every level does."""
        return all(level.takes_whole_rays(device, training, learns_cameras) for level in self._in_order())

    def points_per_ray(self, training: bool) -> float:
        """Return the largest number of points that a ray sends through any field at once: what tiles are cut by."""
        counts = [0.0]
        for level in self._in_order():
            counts.append(level.points_per_ray(counts[-1], training))
        return max(counts)

    @property
    def last(self) -> Level:
        """The level whose picture counts."""
        return self._in_order()[-1]

    def density(self, positions: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        """Return the density per unit length, as the last level's rays find it."""
        return self.last.density(positions)

    def query(self, points: Points) -> FieldOutput:
        """Return density and color of points by themselves, as the last level's field has them."""
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

    def fit_to(self, scene: Scene) -> None:
        """Tell the levels where the scene's content lies, once, before training."""
        for level in self._in_order():
            level.fit_to(scene)

    def sample_counts(self) -> list[Tensor]:
        """Return the buffers of all levels in which a training step counts."""
        return [count for level in self._in_order() for count in level.sample_counts()]

    def buffers_to_average(self) -> list[Tensor]:
        """Return the buffers of all levels that hold means over rays."""
        return [measured for level in self._in_order() for measured in level.buffers_to_average()]

    def set_precision(self, matmul_precision: MatmulPrecision) -> None:
        """Set the precision of the products with the fields' weights; everything else is float32 always."""
        for level in self._in_order():
            level.field.set_precision(matmul_precision)

    def kernels(self) -> tuple[str, ...]:
        """Return the kernels of the levels whose fields kernels know."""
        return tuple(name for level in self._in_order() if level.field.parts() is not None for name in level.kernels)

    def compile_fields(self) -> list[str]:
        """Compile the fields of levels with static shapes (torch.compile), and return the levels' names."""
        for module in self.modules():
            if isinstance(module, Contracted):
                module.is_on()  # read from its buffer in a compiled field, it would cut the program in pieces
        return [name for name, level in zip(self.levels, self._in_order(), strict=True) if level.compile_field()]

    def set_returns_weights(self, wanted: bool) -> None:
        """Set whether renderings in training have weights and samples where they could do without."""
        for level in self._in_order():
            level.returns_weights = wanted

    def update(self, step: int, key: int) -> None:
        """Do what the levels do between steps of training."""
        for level in self._in_order():
            level.update(step, key)

    def statistics(self) -> dict[str, float]:
        """Return what is worth watching while training, of all levels."""
        return {name: value for level in self._in_order() for name, value in level.statistics().items()}

    def gradient_norms(self) -> dict[str, Float[Tensor, ""]]:
        """Return the Euclidean norm of the gradients of each level."""
        return {name: norm_of_gradients(level) for name, level in zip(self.levels, self._in_order(), strict=True)}

    def reset_statistics(self) -> None:
        """Forget what was counted while rendering."""
        for level in self._in_order():
            level.reset_statistics()

    def reset_parameters(self) -> None:
        """Draw every parameter anew from torch's generator."""
        self.subpixels.reset()
        for level in self._in_order():
            level.reset_parameters()

    def _in_order(self) -> list[Level]:
        return cast(list[Level], list(self.levels.values()))

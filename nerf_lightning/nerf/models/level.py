"""The contract of a level: one round of sampling and rendering."""

from abc import abstractmethod
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.fields.base import Field
from nerf_lightning.nerf.part import Part, coupled_parts
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.samplers.base import Sampler
from nerf_lightning.nerf.types.rays import Points, RayBundle
from nerf_lightning.nerf.types.renderings import Rendering


class Level(Part):
    """The contract of a level: one round of sampling and rendering.

    Args:
        sampler: chooses where the field is evaluated.
        field: density and color.
    """

    sampler: Sampler
    field: Field
    has_color = True
    """Whether its rendering is a picture."""

    sampler_kind: type[Sampler] = Sampler
    """The class of samplers that it supports."""

    returns_weights: bool = True
    """Whether renderings in training have weights and samples, for a loss that uses them (`Loss.needs_weights`)."""

    has_static_shapes: bool = True
    """False if shapes depend on what is found along the rays; compilers such as XLA's refuse that."""

    takes_coupled_fields: bool = False
    """Whether a step evaluates the field exactly once, at all samples of its rays, as batch normalization requires
    (`Part.couples_rays`)."""

    kernels: tuple[str, ...] = ()
    """Modules of `nerf.kernels` that it uses on a CPU, if kernels support its field."""

    def __init__(self, sampler: Sampler, field: Field):
        super().__init__()
        if not isinstance(sampler, self.sampler_kind):
            raise ValueError(
                f"{type(self).__name__} samples with {self.sampler_kind.__name__} or what follows it, and "
                f"{type(sampler).__name__} does not: choose another sampler, or a model with another level"
            )
        coupled = coupled_parts(field)
        if coupled and not self.takes_coupled_fields:
            raise ValueError(
                f"{coupled[0]} needs all samples of a step in one call, and {type(self).__name__} makes none: leave "
                "field.batch_norm out, or train a model without an occupancy grid or a proposal (model=nerf)"
            )
        self.sampler = sampler
        self.field = field

    @abstractmethod
    def forward(
        self,
        rays: RayBundle,
        background: Float[Tensor, "*rays 3"] | None,
        history: list[Any],
        random: RayRandom | None,
    ) -> Rendering:
        """Render rays; `history` has the earlier levels' renderings, `random` is None outside training."""

    @abstractmethod
    def points_per_ray(self, before: float, training: bool) -> float:
        """Return how many points a ray sends through the field at once, given the number of the previous level."""

    def takes_whole_rays(self, device: torch.device, training: bool, learns_cameras: bool = False) -> bool:
        """Return whether a kernel processes whole rays (`Model.takes_whole_rays`)."""
        return False

    def density(self, positions: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        """Return the density per unit length, as rendering finds it."""
        return self.sampler.reached_density(self.field_density, positions).float()

    def field_density(self, positions: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        """Return the density per unit length, as the field has it."""
        return self.field.density(Points(positions))[0]

    def compile_field(self) -> bool:
        """Compile the field if its shapes do not depend on the data; return whether it was."""
        return False

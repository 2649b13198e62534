"""A level that only proposes where to look: density without color."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.fields.base import Field
from nerf_lightning.nerf.kernels.render.op import FieldParts
from nerf_lightning.nerf.models.dense_level import DenseLevel
from nerf_lightning.nerf.part import StepContext
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.ranges import require_ranges
from nerf_lightning.nerf.samplers.base import Sampler
from nerf_lightning.nerf.types.rays import Points, RayBundle
from nerf_lightning.nerf.types.renderings import DenseRendering, FieldOutput


class ProposalLevel(DenseLevel):
    """Sample, evaluate only the field's density, and pass on the weights; its picture is black.

    Where to look changes more slowly than what is seen there, so after the first steps the level need not learn in
    every step: the time is better spent on more steps.

    Args:
        sampler: chooses where the field is evaluated.
        field: only its density is used.
        learn_every: the proposal is trained in one of this many steps.
        learn_always: number of steps at the start in each of which it is trained.
        gradient_scaling_distance: distance from the camera (scene units) within which gradients are scaled down,
            against floaters; 0: nowhere, as in `DenseLevel`.
    """

    has_color = False
    takes_coupled_fields = False  # it does not learn in every step

    def __init__(
        self,
        sampler: Sampler,
        field: Field,
        learn_every: int = 1,
        learn_always: int = 100,
        gradient_scaling_distance: float = 0.0,
    ):
        super().__init__(sampler, field, gradient_scaling_distance)
        require_ranges(locals(), {"learn_every": (1, 1 << 20), "learn_always": (0, 1 << 31)})
        self.learn_every, self.learn_always = learn_every, learn_always
        self._learns = True

    @property
    def step_variant(self) -> bool:  # type: ignore[override]
        """Whether the level learns in the next step."""
        return self._learns

    def on_step(self, context: StepContext) -> None:
        """Decide whether to learn in the next step."""
        self._learns = context.step < self.learn_always or context.step % self.learn_every == 0

    def forward(
        self,
        rays: RayBundle,
        background: Float[Tensor, "*rays 3"] | None,
        history: list[DenseRendering],
        random: RayRandom | None,
    ) -> DenseRendering:
        """Sample, evaluate the field's density, and return the weights; without gradients unless it learns.

        Rays of adjacent pixels share the weights of the ray between them: the proposal's cells are wider than pixels.
        """
        if rays.together > 1 and random is None:
            between = [each[:: rays.together] for each in history]
            seen = super().forward(
                rays.between(), None if background is None else background[:: rays.together], between, None
            )
            seen = seen.map(lambda each: each.repeat_interleave(rays.together, dim=0))
            return replace(seen, samples=self.sampler(rays, history, None))
        with torch.set_grad_enabled(torch.is_grad_enabled() and self._learns):
            return super().forward(rays, background, history, random)

    def field_parts(self) -> FieldParts | None:
        """Return the field's parts, without colors."""
        parts = self.field.parts()
        return None if parts is None else replace(parts, color_weights=[])

    def field_output(self, points: Points) -> FieldOutput:
        """Return the density, with black as color."""
        density, _ = self.field.density(points)
        return FieldOutput(density, density.new_zeros(*density.shape, 3))

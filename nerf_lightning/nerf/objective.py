"""What training minimizes: pixels -> rays -> renderings -> what photographs show of them -> named terms of the loss."""

from collections.abc import Iterator
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.nerf.corrections.base import Correction
from nerf_lightning.nerf.losses.base import Loss
from nerf_lightning.nerf.losses.mse import squared_errors
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.subpixels import for_each_ray, mean_over_pixels, random_of_rays
from nerf_lightning.nerf.part import Part, parts_of
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.rendering.blending import background_colors, blend
from nerf_lightning.nerf.types.rays import Batch, PixelIndex, RayBundle, Target
from nerf_lightning.nerf.types.renderings import Rendering
from nerf_lightning.nerf.types.scene import Background
from nerf_lightning.nerf.types.step_output import StepOutput


class Objective(Part):
    """The loss of pixels, with all that learns in it.

    Args:
        model: renders rays, level by level.
        rays: makes the rays through pixels.
        loss: named terms, each with a number per level; the sum of all is minimized.
        background: what lies behind the rays.
        correction: what photographs make of the rendered colors; None leaves them alone.
    """

    correction: Correction | None

    def __init__(
        self,
        model: Model,
        rays: RayGenerator,
        loss: Loss,
        background: Background,
        correction: Correction | None = None,
    ):
        super().__init__()
        self.model, self.rays, self.correction = model, rays, correction
        self.loss, self.background = loss, background

    @property
    def together(self) -> int:
        """How many pixels in a row of a batch no tile and no process may part: those of a square."""
        return self.loss.patch**2

    def forward(
        self, batch: Batch, random: RayRandom | None, weight_scale: Float[Tensor, ""] | float = 1.0
    ) -> StepOutput:
        """Return what the levels show of a batch's pixels, and what they lose; gradients flow from `losses`.

        Args:
            batch: pixels of photographs.
            random: the step's numbers for these pixels; None: samples lie in the middles of their intervals, and the
                background is that of evaluation.
            weight_scale: makes the mean weight of the whole batch, of which this may be a tile, 1.
        """
        background = self._background(batch, random)
        target = self._target(batch, background, weight_scale)
        rays, target = self.loss.rays_to_render(self._rays(batch.pixels, batch.pixels.view), target, random)
        renderings = self._render(rays, background, random)
        shown = renderings
        if self.correction is not None:
            shown = [self.correction.photographed(rendering, batch.pixels) for rendering in renderings]
        terms = self.loss(shown, target) | _penalties_of_levels(renderings)
        losses = torch.stack(list(terms.values())).sum(dim=0) if len(terms) > 1 else next(iter(terms.values()))
        with torch.no_grad():
            color_errors = squared_errors(shown, target)
        return StepOutput(
            losses=losses,
            terms={name: levels.detach() for name, levels in terms.items()},
            color_errors=color_errors,
            foreground=renderings[-1].foreground,
            rgb=shown[-1].rgb,
            target=target.rgb,
            weight=target.weight,
            pixels=batch.pixels,
        )

    def neutral(self, batch: Batch) -> tuple[list[Rendering], Target]:
        """Return pixels as evaluation shows them, and their target: no randomness, no photograph's codes or colors."""
        background = self._background(batch, None)
        return self._render(self._rays(batch.pixels), background, None), self._target(batch, background)

    def named_weights(self) -> Iterator[tuple[str, Tensor]]:
        """Return all parameters by name, those of the model by the names that they have there."""
        return ((name.removeprefix("model."), weight) for name, weight in self.named_parameters())

    def penalties(self) -> Iterator[Float[Tensor, ""]]:
        """Return what parts add to the loss of a whole step, whatever its pixels are."""
        return (penalty for part in parts_of(self) if (penalty := part.penalty()) is not None)

    def _rays(self, pixels: PixelIndex, photograph: Int[Tensor, "pixels"] | None = None) -> RayBundle:
        several = self.model.subpixels
        rays = self.rays.of_pixels(pixels, several)
        return rays if photograph is None else replace(rays, photograph=for_each_ray(photograph, several.per_pixel))

    def _render(
        self, rays: RayBundle, background: Float[Tensor, "pixels 3"] | None, random: RayRandom | None
    ) -> list[Rendering]:
        """Return one rendering per level: the mean of each pixel's rays."""
        several = self.model.subpixels
        behind = None if background is None else for_each_ray(background, several.per_pixel)
        numbers = None if random is None else random_of_rays(random, several.per_pixel)
        return [mean_over_pixels(rendering, several.per_pixel) for rendering in self.model(rays, behind, numbers)]

    def _background(self, batch: Batch, random: RayRandom | None) -> Float[Tensor, "pixels 3"] | None:
        return background_colors(self.background, batch.num_rays, batch.weight.device, random, batch.rgba)

    def _target(
        self,
        batch: Batch,
        background: Float[Tensor, "pixels 3"] | None,
        weight_scale: Float[Tensor, ""] | float = 1.0,
    ) -> Target:
        target = Target(blend(batch.rgba, background), batch.weight * weight_scale, batch.pixels)
        if batch.distance is None:
            return target
        distance, infinity = self.rays.distance_along(batch.pixels, batch.distance)
        return replace(target, distance=distance, certainty=batch.certainty, infinity=infinity)


def _penalties_of_levels(renderings: list[Rendering]) -> dict[str, Float[Tensor, "levels"]]:
    """Return the penalties of levels as one more term of the loss; no term where no level has one."""
    if all(rendering.penalty is None for rendering in renderings):
        return {}
    none = torch.zeros_like(renderings[0].depth[0])
    return {"penalty": torch.stack([none if each.penalty is None else each.penalty.mean() for each in renderings])}

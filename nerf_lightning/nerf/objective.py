"""The training objective: pixels -> rays -> renderings -> colors as photographed -> named terms of the loss."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.corrections.base import Correction
from nerf_lightning.nerf.losses.base import Loss
from nerf_lightning.nerf.losses.mse import squared_errors
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.ray_generator import RayGenerator, for_each_ray, mean_over_pixels, random_of_rays
from nerf_lightning.nerf.part import Part, parts_of
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.rendering.background import background_colors, blend
from nerf_lightning.nerf.types.rays import Batch, PixelIndex, RayBundle, Target
from nerf_lightning.nerf.types.renderings import Rendering
from nerf_lightning.nerf.types.scene import Background
from nerf_lightning.nerf.types.tensor_struct import TensorStruct, concatenate


@dataclass(frozen=True)
class StepOutput(TensorStruct):
    """A step's renderings and losses, detached. Callbacks get it as `outputs["step"]`.

    If steps are recorded and replayed, the next one overwrites it: clone what you keep.
    """

    losses: Float[Tensor, "levels"]
    """Losses of the whole batch, over all processes; their sum was minimized, plus the penalties of parts."""
    terms: dict[str, Float[Tensor, "levels"]]
    """The losses by term."""
    color_errors: Float[Tensor, "levels"]
    """Mean squared errors of the levels' colors, over all processes; meaningless for a level without color."""
    foreground: Float[Tensor, "rays 3"]
    """The last level's light, without the background's; of this process's rays, like all that follows."""
    rgb: Float[Tensor, "rays 3"]
    """The last level's colors, as compared with `target`."""
    target: Float[Tensor, "rays 3"]
    weight: Float[Tensor, "rays"]
    """Weight of each color, 1 on average; 0 for masked pixels, and for moved rays (`Loss.rays_to_render`)."""
    pixels: PixelIndex
    gradient_norms: dict[str, Float[Tensor, ""]] = field(default_factory=dict)
    """Norms by level, before clipping; empty if they were not measured or the step was not taken."""

    def scaled(self, share: float) -> "StepOutput":
        """Return the contribution of a tile, `share` of its batch, to the losses and errors of the whole batch."""
        if share >= 1.0:
            return self
        terms = {name: levels * share for name, levels in self.terms.items()}
        return replace(self, losses=self.losses * share, terms=terms, color_errors=self.color_errors * share)

    @classmethod
    def joined(cls, tiles: Sequence["StepOutput"]) -> "StepOutput":
        """Return the sum of tiles, with their rays concatenated."""
        if len(tiles) == 1:
            return tiles[0]
        return cls(
            losses=torch.stack([each.losses for each in tiles]).sum(0),
            terms={name: torch.stack([each.terms[name] for each in tiles]).sum(0) for name in tiles[0].terms},
            color_errors=torch.stack([each.color_errors for each in tiles]).sum(0),
            foreground=torch.cat([each.foreground for each in tiles]),
            rgb=torch.cat([each.rgb for each in tiles]),
            target=torch.cat([each.target for each in tiles]),
            weight=torch.cat([each.weight for each in tiles]),
            pixels=concatenate([each.pixels for each in tiles]),
        )


class Objective(Part):
    """The loss of pixels, with all modules that learn.

    Args:
        model: renders rays, level by level.
        rays: generates the rays through pixels.
        loss: named terms, each with a number per level; the sum of all is minimized.
        background: what is behind the rays.
        correction: maps rendered colors to photographed ones; None: the identity.

    Raises:
        InputError: several rays per pixel with a loss that depends on single rays.
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
        if model.subpixels.side > 1 and loss.needs_weights:
            raise InputError(
                f"model.subpixels={model.subpixels.side} compares the mean of several rays with a photograph's pixel, "
                f"and the loss {type(loss).__name__} looks at the samples of single rays, as model=fast_proposal wants "
                "it. Leave model.subpixels out, or choose another loss or model."
            )
        self.model, self.rays, self.correction = model, rays, correction
        self.loss, self.background = loss, background

    @property
    def pixels_per_patch(self) -> int:
        """Number of consecutive pixels that no tile or process may separate: those of a patch."""
        return self.loss.patch**2

    def forward(
        self, batch: Batch, random: RayRandom | None, weight_scale: Float[Tensor, ""] | float = 1.0
    ) -> StepOutput:
        """Return the levels' renderings of a batch's pixels, and their losses; gradients flow from `losses`.

        Args:
            batch: pixels of photographs.
            random: the step's random numbers for these pixels; None: samples are in the middle of their intervals, and
                the background is that of evaluation.
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
        """Return pixels as evaluation shows them, and their target: without randomness, embeddings and corrections."""
        background = self._background(batch, None)
        return self._render(self._rays(batch.pixels), background, None), self._target(batch, background)

    def named_weights(self) -> Iterator[tuple[str, Tensor]]:
        """Yield all parameters by name, those of the model by their names within it."""
        return ((name.removeprefix("model."), weight) for name, weight in self.named_parameters())

    def penalties(self) -> Iterator[Float[Tensor, ""]]:
        """Yield the penalties of parts, which are added to the loss of a whole step, independent of its pixels."""
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
    """Return the penalties of levels as another term of the loss; no term if no level has one."""
    if all(rendering.penalty is None for rendering in renderings):
        return {}
    none = torch.zeros_like(renderings[0].depth[0])
    return {"penalty": torch.stack([none if each.penalty is None else each.penalty.mean() for each in renderings])}

"""The contract of a correction: how a photograph changed the light that reached its camera."""

from abc import ABC, abstractmethod
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.part import Part
from nerf_lightning.nerf.rendering.background import in_other_light
from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.nerf.types.renderings import Rendering
from nerf_lightning.nerf.types.scene import SceneRecord


class Correction(Part, ABC):
    """Map the colors that a model renders to those that a photograph shows.

    A training step applies it after compositing and before the loss, so that the model need not explain what differs
    between photographs. Nothing else applies it: validation, evaluation, films, exports and the viewer show the model's
    own, neutral colors. Initially it changes no bit.
    """

    def fit_to(self, scene: SceneRecord) -> None:
        """Record the photographs, once, before training.

        Raises:
            InputError: there is only one training photograph, so no colors differ.
        """
        if len(scene.splits["train"]) < 2:
            raise InputError(
                f"The scene {scene.name} trains on one photograph, and a correction learns how the colors of several "
                "differ: add correction=none, or give more photographs."
            )

    def photographed(self, rendering: Rendering, pixels: PixelIndex) -> Rendering:
        """Return a rendering with the colors that photographs show.

        The scene's own light reached the camera. The background did not: it looks the same in all.

        Args:
            rendering: of one ray for each pixel.
            pixels: the photograph and pixel of each ray.
        """
        light = rendering.rgb, rendering.foreground, rendering.opacity
        return replace(rendering, rgb=in_other_light(lambda straight: self(straight, pixels), *light))

    @abstractmethod
    def forward(self, rgb: Float[Tensor, "*rays 3"], pixels: PixelIndex) -> Float[Tensor, "*rays 3"]:
        """Return what photographs show of rendered colors.

        Args:
            rgb: sRGB-encoded, composited; in [0, 1] or somewhat beyond. The output is the same, not clamped.
            pixels: the photograph and pixel of each color.
        """

    def neutral(self, rgb: Float[Tensor, "*rays 3"], pixels: PixelIndex) -> Float[Tensor, "*rays 3"] | None:
        """Return the neutral colors of what photographs show, the inverse of `forward`; None: unknown.

        Splats are fitted to photographs with neutral colors.
        """
        return None


class NoCorrection(Correction):
    """Leave every color unchanged."""

    def fit_to(self, scene: SceneRecord) -> None:
        """Take any scene."""

    def photographed(self, rendering: Rendering, pixels: PixelIndex) -> Rendering:
        """Return the rendering itself."""
        return rendering

    def forward(self, rgb: Float[Tensor, "*rays 3"], pixels: PixelIndex) -> Float[Tensor, "*rays 3"]:
        """Return the colors themselves."""
        return rgb

    def neutral(self, rgb: Float[Tensor, "*rays 3"], pixels: PixelIndex) -> Float[Tensor, "*rays 3"]:
        """Return the colors themselves."""
        return rgb

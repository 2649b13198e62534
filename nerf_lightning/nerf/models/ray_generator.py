"""Rays through the pixels of views: the one place where cameras become rays, in training, evaluation and films."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.cameras import rays_through_pixels
from nerf_lightning.nerf.learnt_part import LearntPart
from nerf_lightning.nerf.refinements.base import Refinement
from nerf_lightning.nerf.refinements.carry import carry_along
from nerf_lightning.nerf.refinements.none import NoRefinement
from nerf_lightning.nerf.types.rays import PixelIndex, RayBundle
from nerf_lightning.nerf.types.scene import Cameras

MOVED = ("c2w", "focal", "center", "lens", "width", "height", "ndc")


class RayGenerator(LearntPart):
    """Make the rays through pixels of views, on the device that it was moved to.

    It is a module so that cameras may be learnt: they are a function of the parameters of its refinement. What it is
    given is data, and stands in no checkpoint's weights.

    Args:
        cameras: one per view.
        near: distance at which the rays of each view begin, scene units.
        far: where they end.
        refinement: what learns of the cameras; None: nothing.
    """

    near: Tensor
    far: Tensor

    def __init__(
        self,
        cameras: Cameras,
        near: Float[Tensor, "views"],
        far: Float[Tensor, "views"],
        refinement: Refinement | None = None,
    ):
        super().__init__()
        self.refinement = NoRefinement() if refinement is None else refinement
        self.learning_rate = self.refinement.learning_rate
        self.lens_model = cameras.lens_model
        for name in MOVED:
            self.register_buffer(name, getattr(cameras, name), persistent=False)
        self.register_buffer("near", near, persistent=False)
        self.register_buffer("far", far, persistent=False)

    @property
    def cameras(self) -> Cameras:
        """The cameras that rays start from, as they have been learnt so far."""
        return self.refinement(self.given)

    @property
    def given(self) -> Cameras:
        """The cameras as they were before anything was learnt."""
        return Cameras(lens_model=self.lens_model, **{name: getattr(self, name) for name in MOVED})

    def forward(self, pixels: PixelIndex) -> RayBundle:
        """Return the rays through the centres of pixels, in the world or in normalised device coordinates."""
        return rays_through_pixels(self.cameras, pixels, self.near, self.far)

    def follow(self, share: float) -> None:
        """Take note of how far the run is, before each step of training: `share` of its steps have been taken."""
        self.refinement.follow(share)

    def penalty(self) -> Float[Tensor, ""] | None:
        """Return what keeps the cameras from moving far."""
        return self.refinement.penalty()

    def reset_parameters(self) -> None:
        """Put the cameras back to where they were given."""
        self.refinement.reset_parameters()

    def refined(self, trained: Sequence[int]) -> Cameras | None:
        """Return the cameras as learnt, on the CPU, the others carried along (`carry_along`); None where none learns.

        Args:
            trained: numbers of the views that are trained on.
        """
        if not self.refinement.moves():
            return None
        with torch.no_grad():
            return carry_along(self.given.to("cpu"), self.cameras.to("cpu"), trained)

    def through_world(self, pixels: PixelIndex) -> RayBundle:
        """Return the rays through the world, wherever those of `forward` run."""
        return rays_through_pixels(replace(self.cameras, ndc=None), pixels, self.near, self.far)

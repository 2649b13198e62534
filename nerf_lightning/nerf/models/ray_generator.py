"""Rays through the pixels of views: the one place where cameras become rays, in training, evaluation and films."""

from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.cameras import rays_through_pixels
from nerf_lightning.nerf.learnt_part import LearntPart
from nerf_lightning.nerf.types.rays import PixelIndex, RayBundle
from nerf_lightning.nerf.types.scene import Cameras

MOVED = ("c2w", "focal", "center", "lens", "width", "height", "ndc")


class RayGenerator(LearntPart):
    """Make the rays through pixels of views, on the device that it was moved to.

    It is a module so that cameras may be learnt, corrected or perturbed: whoever does so derives from it and returns
    other cameras, as a function of its parameters. What it is given is data, and stands in no checkpoint's weights.

    Args:
        cameras: one per view.
        near: distance at which the rays of each view begin, scene units.
        far: where they end.
    """

    near: Tensor
    far: Tensor

    def __init__(self, cameras: Cameras, near: Float[Tensor, "views"], far: Float[Tensor, "views"]):
        super().__init__()
        self.lens_model = cameras.lens_model
        for name in MOVED:
            self.register_buffer(name, getattr(cameras, name), persistent=False)
        self.register_buffer("near", near, persistent=False)
        self.register_buffer("far", far, persistent=False)

    @property
    def cameras(self) -> Cameras:
        """The cameras that rays start from."""
        return Cameras(lens_model=self.lens_model, **{name: getattr(self, name) for name in MOVED})

    def forward(self, pixels: PixelIndex) -> RayBundle:
        """Return the rays through the centres of pixels, in the world or in normalised device coordinates."""
        return rays_through_pixels(self.cameras, pixels, self.near, self.far)

    def through_world(self, pixels: PixelIndex) -> RayBundle:
        """Return the rays through the world, wherever those of `forward` run."""
        return rays_through_pixels(replace(self.cameras, ndc=None), pixels, self.near, self.far)

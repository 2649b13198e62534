"""Rays through the pixels of views: the one place where cameras become rays, in training, evaluation and films.

Several rays may go through each pixel; their mean is what a photograph's pixel shows: the light of its area. One ray
through the center sees a point of that area. What is learned this way is blurred by a pixel, and differently from every
side, so that other views are less sharp than the training views (Sec. 1, arXiv 2103.13415). The mean over a grid of
rays is the simple cure; it multiplies the number of samples, so it is for the end of a run.

How many rays, and from when on: `subpixels` in conf/model/, for model=auto `config/auto_settings.py`.
"""

from collections.abc import Sequence
from dataclasses import fields, replace

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from nerf_lightning.messages.errors import ANOTHER, InputError
from nerf_lightning.nerf.geometry.cameras import at_most, rays_through_pixels
from nerf_lightning.nerf.geometry.ndc import share_at_distance
from nerf_lightning.nerf.part import Part, StepContext
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.ranges import require_ranges
from nerf_lightning.nerf.refinements.base import Refinement
from nerf_lightning.nerf.refinements.displacements import align_untrained_cameras
from nerf_lightning.nerf.types.rays import PixelIndex, RayBundle
from nerf_lightning.nerf.types.renderings import Rendering
from nerf_lightning.nerf.types.scene import Cameras, SceneRecord

MOVED = ("c2w", "focal", "center", "lens", "width", "height", "ndc")

MOST_PER_SIDE = 8
"""Rays along each side of a pixel."""


class Subpixels(Part):
    """The current number of rays through each pixel, along each of its sides.

    Args:
        side: rays along each side in the last part of the run, and in pictures from then on; 1: one through the center.
        start: share of the run before that part; until then there is one.
    """

    now: Tensor

    @property
    def replays(self) -> bool:  # type: ignore[override]
        """Whether the number of rays is constant."""
        return self.side == 1

    def __init__(self, side: int = 1, start: float = 0.0):
        super().__init__()
        require_ranges(
            {"subpixels": side, "subpixels_from": start}, {"subpixels": (1, MOST_PER_SIDE), "subpixels_from": (0, 1)}
        )
        self.side, self.start = side, start
        self._now = 1  # mirrors the buffer, which is not read at each step
        if side > 1:
            # In the checkpoint, so that it renders as the last step did.
            self.register_buffer("now", torch.ones((), dtype=torch.int64))

    @property
    def per_side(self) -> int:
        """Rays along each side of a pixel."""
        return self._now

    @property
    def per_pixel(self) -> int:
        """Rays through each pixel."""
        return self._now**2

    def offsets(self, device: torch.device | str = "cpu") -> Float[Tensor, "per_pixel 2"]:
        """Return the positions of a pixel's rays, in pixels from its center (x, y), row by row.

        >>> halves = Subpixels(2)
        >>> halves.on_step(StepContext(progress=0.9, step=9, key=0))
        >>> halves.offsets().tolist()
        [[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]]
        """
        along = (torch.arange(self._now, device=device) + 0.5) / self._now - 0.5
        return torch.cartesian_prod(along, along).view(-1, 2).flip(-1)

    def on_step(self, context: StepContext) -> None:
        """Use several rays per pixel from `start` on."""
        self._set(self.side if context.progress >= self.start else 1)

    def reset_parameters(self) -> None:
        """Reset to one ray through each pixel's center."""
        self._set(1)

    def validate_state(self) -> None:
        """Check the loaded state.

        Raises:
            InputError: an impossible number of rays.
        """
        if self.side > 1:
            if int(self.now) not in (1, self.side):
                raise InputError(f"The rays of a pixel in the model's state are {int(self.now)} a side. {ANOTHER}")
            self._now = int(self.now)

    def _set(self, now: int) -> None:
        if now != self._now:
            self._now = now
            self.now.fill_(now)


class RayGenerator(Part):
    """Generate the rays through pixels of views, on the module's device.

    It is a module so that cameras may be learned: they are a function of its refinement's parameters. Its arguments are
    data, and not part of a checkpoint's weights.

    Args:
        cameras: one per view.
        near: distance at which the rays of each view begin, scene units.
        far: distance at which they end.
        refinement: the learned change of the cameras; None: nothing is learned.
        capture_of: number of each view's capture, if several were joined; None: one.
        names_photographs: whether rays name their photograph outside training, too: for models that render from
            photographs, except from the very one that is requested.
    """

    refinement: Refinement | None
    near: Tensor
    far: Tensor
    capture_of: Tensor | None

    def __init__(
        self,
        cameras: Cameras,
        near: Float[Tensor, "views"],
        far: Float[Tensor, "views"],
        refinement: Refinement | None = None,
        capture_of: Sequence[int] | None = None,
        names_photographs: bool = False,
    ):
        super().__init__()
        self.refinement = refinement
        self.lens_model = cameras.lens_model
        for name in MOVED:
            self.register_buffer(name, getattr(cameras, name), persistent=False)
        self.register_buffer("near", near, persistent=False)
        self.register_buffer("far", far, persistent=False)
        self.register_buffer("capture_of", None if capture_of is None else torch.tensor(capture_of), persistent=False)
        self.names_photographs = names_photographs

    @classmethod
    def of_views(
        cls, scene: SceneRecord, names_photographs: bool, refinement: Refinement | None = None
    ) -> "RayGenerator":
        """Return the generator of rays through a scene's own views."""
        return cls(scene.cameras, scene.near, scene.far, refinement, scene.capture_of, names_photographs)

    @torch.no_grad()
    def at_most(self, longest: int) -> "RayGenerator":
        """Return the generator for smaller pictures, whose longer side has at most `longest` pixels."""
        captures = None if self.capture_of is None else self.capture_of.tolist()
        return RayGenerator(at_most(self.cameras, longest), self.near, self.far, None, captures, self.names_photographs)

    @property
    def cameras(self) -> Cameras:
        """The cameras that rays start from, as learned so far."""
        return self.given if self.refinement is None else self.refinement(self.given)

    @property
    def learns_cameras(self) -> bool:
        """Whether anything about them is learned."""
        return self.refinement is not None and self.refinement.moves()

    @property
    def given(self) -> Cameras:
        """The cameras before anything was learned."""
        return Cameras(lens_model=self.lens_model, **{name: getattr(self, name) for name in MOVED})

    def forward(
        self, pixels: PixelIndex, subpixel_offset: Float[Tensor, "*#rays 2"] | None = None, per_side: int = 1
    ) -> RayBundle:
        """Return the rays through pixels, in the world or in normalized device coordinates.

        Args:
            pixels: the pixels.
            subpixel_offset: each ray's offset from the center of its pixel, in pixels (x, y); None: none.
            per_side: number of rays along each side of a pixel.
        """
        rays = rays_through_pixels(self.cameras, pixels, self.near, self.far, subpixel_offset, per_side)
        if self.capture_of is not None:
            rays = replace(rays, capture=self.capture_of[pixels.view])
        return replace(rays, photograph=pixels.view) if self.names_photographs else rays

    def of_pixels(self, pixels: PixelIndex, subpixels: Subpixels) -> RayBundle:
        """Return the rays of consecutive pixels, pixel by pixel, as many for each as `subpixels` says."""
        if subpixels.per_pixel == 1:
            return self(pixels)
        subpixel_offset = subpixels.offsets(pixels.x.device).repeat(pixels.x.numel(), 1)
        each = pixels.map(lambda of_pixel: for_each_ray(of_pixel, subpixels.per_pixel))
        return self(each, subpixel_offset, subpixels.per_side)

    def refined(self, trained: Sequence[int]) -> Cameras | None:
        """Return the cameras as learned, with the others aligned to them, on the CPU; None if none learns.

        Args:
            trained: numbers of the views that are trained on.
        """
        if not self.learns_cameras:
            return None
        with torch.no_grad():
            return align_untrained_cameras(self.given.to("cpu"), self.cameras.to("cpu"), trained)

    @torch.no_grad()
    def distance_along(
        self, pixels: PixelIndex, distance: Float[Tensor, "*rays"]
    ) -> tuple[Float[Tensor, "*rays"], Float[Tensor, "*rays"] | None]:
        """Return the distances along rays of `forward` of points at distances in the world, and where these rays end.

        The end is that of normalized device coordinates, which is infinitely far away in the world; else None.
        """
        if self.ndc is None:
            return distance, None
        far = self(pixels).far
        return share_at_distance(self.through_world(pixels), distance) * far, far

    def through_world(self, pixels: PixelIndex, subpixel_offset: Float[Tensor, "*#rays 2"] | None = None) -> RayBundle:
        """Return the rays through the world, even if those of `forward` are in normalized device coordinates."""
        return rays_through_pixels(replace(self.cameras, ndc=None), pixels, self.near, self.far, subpixel_offset)


def for_each_ray(of_pixel: Shaped[Tensor, "pixels *of"], per_pixel: int) -> Shaped[Tensor, "rays *of"]:
    """Repeat each pixel's values for its rays; the rays of a pixel are consecutive."""
    return of_pixel if per_pixel == 1 else of_pixel.repeat_interleave(per_pixel, dim=0)


def random_of_rays(random: RayRandom, per_pixel: int) -> RayRandom:
    """Return random numbers for each ray of pixels; with one ray per pixel, those of the pixel."""
    if per_pixel == 1:
        return random
    number = torch.arange(per_pixel, device=random.slots.device)
    slots = (random.slots[:, None] * per_pixel + number).flatten()
    return RayRandom(for_each_ray(random.key, per_pixel), slots)


def mean_over_pixels(rendering: Rendering, per_pixel: int) -> Rendering:
    """Return what pixels show: the means over their rays, without samples."""
    if per_pixel == 1:
        return rendering
    plain = Rendering(**{each.name: getattr(rendering, each.name) for each in fields(Rendering)})
    return plain.map(lambda of_rays: of_rays.unflatten(0, (-1, per_pixel)).mean(dim=1))

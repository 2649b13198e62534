"""Several rays through each pixel, whose mean is what a photograph's pixel shows: the light of its area.

One ray through the center sees a point of that area. What is learned so is blurred by a pixel, and not alike from every
side, so that other views are less sharp than those that taught it (Sec. 1, arXiv 2103.13415). The mean over a grid of
rays is the plain cure; it costs as many times the samples, so it is for the end of a run.
"""

from dataclasses import fields

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from nerf_lightning.messages.errors import ANOTHER, InputError
from nerf_lightning.nerf.part import Part, StepContext
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.ranges import require_ranges
from nerf_lightning.nerf.types.renderings import Rendering

MOST = 8


class Subpixels(Part):
    """How many rays go through each pixel now, along each of its sides.

    Args:
        side: rays along each side in the last part of the run, and in pictures from then on; 1: one through the center.
        start: share of the run before that part; until then there is one.
    """

    now: Tensor

    @property
    def replays(self) -> bool:  # type: ignore[override]
        """Whether the number of rays stays as it is."""
        return self.side == 1

    def __init__(self, side: int = 1, start: float = 0.0):
        super().__init__()
        require_ranges({"subpixels": side, "subpixels_from": start}, {"subpixels": (1, MOST), "subpixels_from": (0, 1)})
        self.side, self.start = side, start
        self._now = 1  # as in the buffer, which is not read at each step
        if side > 1:
            # In the checkpoint, so that its pictures are made as the last step was.
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
        """Return where in a pixel its rays go through, in pixels from its center (x, y), row by row.

        >>> halves = Subpixels(2)
        >>> halves.on_step(StepContext(progress=0.9, step=9, key=0))
        >>> halves.offsets().tolist()
        [[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]]
        """
        along = (torch.arange(self._now, device=device) + 0.5) / self._now - 0.5
        return torch.cartesian_prod(along, along).view(-1, 2).flip(-1)

    def on_step(self, context: StepContext) -> None:
        """Take several rays a pixel from `start` on."""
        self._set(self.side if context.progress >= self.start else 1)

    def reset_parameters(self) -> None:
        """Begin with one ray through each pixel's center."""
        self._set(1)

    def validate_state(self) -> None:
        """Look at what was loaded.

        Raises:
            InputError: a number of rays that was never asked for.
        """
        if self.side > 1:
            if int(self.now) not in (1, self.side):
                raise InputError(f"The rays of a pixel in the model's state are {int(self.now)} a side. {ANOTHER}")
            self._now = int(self.now)

    def _set(self, now: int) -> None:
        if now != self._now:
            self._now = now
            self.now.fill_(now)


def for_each_ray(of_pixel: Shaped[Tensor, "pixels *of"], per_pixel: int) -> Shaped[Tensor, "rays *of"]:
    """Return what each ray has of its pixel: rays of one pixel lie one after the other."""
    return of_pixel if per_pixel == 1 else of_pixel.repeat_interleave(per_pixel, dim=0)


def random_of_rays(random: RayRandom, per_pixel: int) -> RayRandom:
    """Return random numbers for each ray of pixels; for one ray a pixel those of the pixel."""
    if per_pixel == 1:
        return random
    number = torch.arange(per_pixel, device=random.slots.device)
    slots = (random.slots[:, None] * per_pixel + number).flatten()
    return RayRandom(for_each_ray(random.key, per_pixel), slots)


def mean_over_pixels(rendering: Rendering, per_pixel: int) -> Rendering:
    """Return what pixels show: the means over their rays, and no samples."""
    if per_pixel == 1:
        return rendering
    plain = Rendering(**{each.name: getattr(rendering, each.name) for each in fields(Rendering)})
    return plain.map(lambda of_rays: of_rays.unflatten(0, (-1, per_pixel)).mean(dim=1))

"""A trimmed loss that ignores what only some photographs show: people, cars, shadows, reflections.

RobustNeRF (Sabour et al., 2023, arXiv 2302.00833): what the scene cannot explain has clustered large residuals, whereas
fine detail has large residuals among small ones.

The share that is kept: `conf/loss/robust.yaml`.
"""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from nerf_lightning.nerf.losses.base import Loss
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.ranges import require_ranges
from nerf_lightning.nerf.types.rays import RayBundle, Target

LEAST_NEAR, LEAST_AROUND = 0.5, 0.6
"""Minimum shares of good pixels for which a pixel is kept because of its neighbors: in 3 x 3, and in the whole
square."""
MEMORY = 0.9
"""Weight of the old threshold in its update per step; a single batch may show hardly anything but people."""
FIRST_THRESHOLD = 1.0
"""No residual of colors in [0, 1] is larger: at first nothing is left out."""
RANGES = {"share": (0.01, 1.0), "times": (0.1, 1000.0), "patch": (4, 256)}


class RobustLoss(Loss):
    """Exclude the pixels that the scene does not explain from another loss.

    The threshold is learned: a multiple of a quantile of the last picture's residuals, averaged over the steps. Rays
    come in squares of pixels; those beyond the last whole square are all kept.

    The paper's threshold is the median itself, which suppresses detail over the hundreds of thousands of steps that it
    trains, and its squares are 16 x 16 pixels. Shorter trainings need a threshold that most of the scene is below at
    any time, and steps that see more places.

    Args:
        of: the loss of the remaining pixels, for all levels.
        share: the minimum share of pixels that show the static scene. A smaller share trims more: passers-by sooner,
            fine detail later. It must exceed the share of a plain background, whose residuals are 0.
        times: the threshold, in units of that quantile (of squared errors: 4 is twice the distance of colors).
        patch: side of the patches in pixels.

    Raises:
        ValueError: a number out of its range.
    """

    replays = False

    def __init__(self, of: Loss, share: int | float = 0.8, times: int | float = 4.0, patch: int = 4):
        super().__init__()
        require_ranges({"share": share, "times": times, "patch": patch}, RANGES)
        self.of, self.share, self.times, self.patch = of, share, times, patch
        self.needs_weights, self.depth_every = of.needs_weights, of.depth_every
        self.register_buffer("threshold", torch.tensor(FIRST_THRESHOLD))

    threshold: Tensor
    """Largest residual of a pixel that is kept regardless of its neighbors."""

    def rays_to_render(self, rays: RayBundle, target: Target, random: RayRandom | None) -> tuple[RayBundle, Target]:
        """Return the rays of the other loss."""
        return self.of.rays_to_render(rays, target, random)

    def forward(self, renderings: list[Any], target: Target) -> dict[str, Float[Tensor, "levels"]]:
        """Return the other loss over the rays that are kept; the others have weight 0."""
        error = residuals(renderings[-1].rgb.detach(), target.rgb)
        # Masked pixels do not count against their neighbors.
        kept = kept_pixels((error <= self.threshold) | (target.weight == 0), self.patch)
        return self.of(renderings, replace(target, weight=target.weight * kept))

    @torch.no_grad()
    def after_step(
        self, rgb: Float[Tensor, "rays 3"], target: Float[Tensor, "rays 3"], weight: Float[Tensor, "rays"]
    ) -> None:
        """Move the threshold toward that of a step's residuals, without masked pixels."""
        known = torch.where(weight > 0, residuals(rgb, target), torch.nan)
        wanted = self.times * torch.nanquantile(known, float(self.share))
        moved = MEMORY * self.threshold + (1.0 - MEMORY) * wanted
        self.threshold.copy_(torch.where(torch.isfinite(moved), moved, self.threshold))

    def buffers_to_average(self) -> list[Tensor]:
        """Return the threshold, on which the processes of a run must agree."""
        return [self.threshold]

    def reset_parameters(self) -> None:
        """Reset the threshold, so that nothing is left out."""
        super().reset_parameters()
        self.threshold.fill_(FIRST_THRESHOLD)


def residuals(rgb: Float[Tensor, "rays 3"], target: Float[Tensor, "rays 3"]) -> Float[Tensor, "rays"]:
    """Return the mean squared error of each ray's color."""
    return (rgb - target).square().mean(dim=-1)


def kept_pixels(good: Bool[Tensor, "rays"], patch: int) -> Bool[Tensor, "rays"]:
    """Return which pixels are trained on: the good ones, and others with mostly good surroundings.

    Eq. 8 to 10 of arXiv 2302.00833: a pixel is kept if it is good, or at least half of its 3 x 3 neighbors (those
    within the square) are, or it is in the inner half of a square (8 x 8 of 16 x 16) of which 60 % are kept so.

    Args:
        good: squares of pixels one after another, row by row.
        patch: side of the squares.
    """
    whole = len(good) // patch**2 * patch**2
    squares = good[:whole].view(-1, 1, patch, patch)
    near = avg_pool2d(squares.float(), 3, stride=1, padding=1, count_include_pad=False) >= LEAST_NEAR
    kept = squares | near
    around = kept.float().mean(dim=(2, 3), keepdim=True) >= LEAST_AROUND
    inner = torch.zeros_like(kept[:1])
    inner[..., patch // 4 : patch - patch // 4, patch // 4 : patch - patch // 4] = True
    return torch.cat([(kept | (around & inner)).flatten(), torch.ones_like(good[whole:])])

"""Depth of sparse points as supervision: weights along a ray gather where structure from motion saw a surface."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.losses.base import Loss
from nerf_lightning.nerf.part import StepContext
from nerf_lightning.nerf.ranges import require_ranges
from nerf_lightning.nerf.rendering.ragged import sum_over_rays
from nerf_lightning.nerf.types.rays import Target
from nerf_lightning.nerf.types.renderings import DenseRendering, RaggedRendering

RANGES = {"every": (2, 1024), "fade": (0.0, 1.0)}


class DepthLoss(Loss):
    """Pull the weights of the last level to known distances: sum_i w_i min(1, |log(t_i / d)|) + 1 - sum_i w_i.

    The logarithm makes near and far surfaces count alike, and its bound leaves outliers little say. A mean over the
    rays whose distance d is known, each weighted by its certainty; those are pixels that structure from motion found
    again in other photographs, or that a depth sensor measured (`Scene.depths`).

    Args:
        every: one in this many rays of a step passes through such a pixel; its color is trained like any other.
        fade: factor to which the term decays exponentially by the end of the run, when colors are more accurate.

    Raises:
        ValueError: a number out of its range.
    """

    needs_weights = True

    def __init__(self, every: int = 8, fade: float = 0.001):
        super().__init__()
        require_ranges({"every": every, "fade": fade}, RANGES)
        self.depth_every, self.fade = every, float(fade)
        self.register_buffer("factor", torch.ones(()), persistent=False)

    factor: Tensor

    def on_step(self, context: StepContext) -> None:
        """Fade."""
        self.factor.fill_(self.fade**context.progress)

    def forward(
        self, renderings: list[DenseRendering | RaggedRendering], target: Target
    ) -> dict[str, Float[Tensor, "levels"]]:
        """Return the weighted mean over rays of known distance, of the last level."""
        last, none = renderings[-1], torch.zeros_like(renderings[-1].depth[0])
        if target.distance is None or target.certainty is None:
            return {"depth": torch.stack([none] * len(renderings))}
        error = distance_error(last, target.distance, target.infinity) + (1.0 - last.opacity)
        # A mean over all rays, so that tiles add up; only one of `depth_every` has a distance.
        mean = (error * target.certainty).mean() * self.depth_every
        return {"depth": torch.stack([*[none] * (len(renderings) - 1), self.factor * mean])}


def distance_error(
    rendering: DenseRendering | RaggedRendering,
    distance: Float[Tensor, "rays"],
    infinity: Float[Tensor, "rays"] | None,
) -> Float[Tensor, "rays"]:
    """Return sum_i w_i min(1, |log(z_i / z)|) of each ray, where z_i / z is the ratio of depths of t_i and `distance`.

    In normalized device coordinates the depth at t is z_near / (1 - t / infinity) (`ndc.world_distance`).
    """
    t = rendering.samples.midpoints
    if isinstance(rendering, RaggedRendering):
        ray = rendering.samples.ray_index
        distance, infinity = distance[ray], None if infinity is None else infinity[ray]
    else:
        distance, infinity = distance[:, None], None if infinity is None else infinity[:, None]
    ratio = t / distance if infinity is None else (infinity - distance) / (infinity - t).clamp(min=1e-6)
    off = rendering.weights * ratio.clamp(min=1e-6).log().abs().clamp(max=1.0)
    if isinstance(rendering, RaggedRendering):
        return sum_over_rays(off[:, None], rendering.samples)[:, 0]
    return off.sum(dim=-1)

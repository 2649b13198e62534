"""Depth supervision by sparse points: weights along a ray gather where structure from motion saw a surface.

Its weight and its share of rays: `conf/loss/depth.yaml`.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.losses.base import Loss
from nerf_lightning.nerf.part import StepContext
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.ranges import require_ranges
from nerf_lightning.nerf.rendering.quadrature import sum_over_rays
from nerf_lightning.nerf.types.rays import RayBundle, Target
from nerf_lightning.nerf.types.renderings import DenseRendering, RaggedRendering

AT_THE_POINT = 0.9
"""Share of a known distance beyond which weights belong to the point."""
RANGES = {"every": (2, 1024), "fade": (0.0, 1.0), "beside": (0.0, 1.0), "reach": (0.0, 10.0)}


class DepthLoss(Loss):
    """Pull the weights of the last level to known distances: sum_i w_i min(1, |log(t_i / d)|) + 1 - sum_i w_i.

    The logarithm makes near and far surfaces count alike, and its bound leaves outliers little say. A mean over the
    rays whose distance d is known, each weighted by its certainty; those are pixels that structure from motion found
    again in other photographs, or that a depth sensor measured (`Scene.depths`).

    Args:
        every: one in this many rays of a step passes through such a pixel; its color is trained like any other.
        fade: factor to which the term decays exponentially by the end of the run, when colors are more accurate.
        beside: share of these rays that come from beside their cameras, against fog that no photograph forbids:
            a surface point that a camera sees is seen from around it, too, in the same color. In normalized device
            coordinates there are none.
        reach: standard deviation of their origins, along two axes across the ray, as a share of the point's distance.

    Raises:
        ValueError: a number out of its range.
    """

    needs_weights = True

    def __init__(self, every: int = 8, fade: float = 0.001, beside: float = 0.5, reach: float = 0.2):
        super().__init__()
        require_ranges(locals(), RANGES)
        self.depth_every, self.fade, self.beside, self.reach = every, float(fade), float(beside), float(reach)
        self.register_buffer("factor", torch.ones(()), persistent=False)

    factor: Tensor

    def on_step(self, context: StepContext) -> None:
        """Decay the term."""
        self.factor.fill_(self.fade**context.progress)

    def rays_to_render(self, rays: RayBundle, target: Target, random: RayRandom | None) -> tuple[RayBundle, Target]:
        """Return the rays, with some of those to known points moved beside their cameras; colors are the cameras'."""
        if target.distance is None or target.certainty is None or target.infinity is not None:
            return rays, target
        if random is None or not self.beside:
            return rays, target
        moved = (target.certainty > 0.0) & (random.uniform("beside", 1)[:, 0] < self.beside)
        origins, directions, distance = from_beside(rays, target.distance, self.reach * random.normal("beside.at", 3))
        rays = replace(
            rays,
            origins=torch.where(moved[:, None], origins, rays.origins),
            directions=torch.where(moved[:, None], directions, rays.directions),
        )
        # Colors of moved rays do not count, and the mean weight of the batch stays 1.
        weight = torch.where(moved, 0.0, target.weight * self.depth_every / (self.depth_every - self.beside))
        return rays, replace(target, distance=torch.where(moved, distance, target.distance), weight=weight)

    def forward(
        self, renderings: list[DenseRendering | RaggedRendering], target: Target
    ) -> dict[str, Float[Tensor, "levels"]]:
        """Return the last level's weighted mean over rays of known distance."""
        last, none = renderings[-1], torch.zeros_like(renderings[-1].depth[0])
        if target.distance is None or target.certainty is None:
            return {"depth": torch.stack([none] * len(renderings))}
        error = distance_error(last, target.distance, target.infinity) + (1.0 - last.opacity)
        # Seen from the side, something solid may hide the point: then only what is half transparent is wrong.
        arrives = 1.0 - weight_before(last, AT_THE_POINT * target.distance).detach()
        error = torch.where(target.weight > 0.0, error, arrives * error)
        # A mean over all rays, so that tiles add up; only one in `depth_every` has a distance.
        mean = (error * target.certainty).mean() * self.depth_every
        return {"depth": torch.stack([*[none] * (len(renderings) - 1), self.factor * mean])}


def from_beside(
    rays: RayBundle, distance: Float[Tensor, "rays"], shift: Float[Tensor, "rays 3"]
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays 3"], Float[Tensor, "rays"]]:
    """Return origins shifted across the rays, unit directions to the same points, and their distances.

    Args:
        rays: in world coordinates.
        distance: distance of the points along the rays.
        shift: shift of the origins as a share of the distance; its component along the ray is ignored.
    """
    points = rays.origins + distance[:, None] * rays.directions
    along = (shift * rays.directions).sum(dim=-1, keepdim=True)
    origins = rays.origins + distance[:, None] * (shift - along * rays.directions)
    toward = points - origins
    farther = toward.norm(dim=-1).clamp(min=1e-6)
    return origins, toward / farther[:, None], farther


def weight_before(
    rendering: DenseRendering | RaggedRendering, distance: Float[Tensor, "rays"]
) -> Float[Tensor, "rays"]:
    """Return the opacity along each ray before `distance`: one minus the light that arrives there."""
    t, weights = rendering.samples.midpoints, rendering.weights
    if isinstance(rendering, RaggedRendering):
        nearer = weights * (t < distance[rendering.samples.ray_index])
        return sum_over_rays(nearer[:, None], rendering.samples)[:, 0]
    return (weights * (t < distance[:, None])).sum(dim=-1)


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

"""From rays and their samples to the points at which a field is evaluated, in both layouts."""

from typing import Any

from torch import Tensor

from nerf_lightning.nerf.geometry.cones import cone_covariance
from nerf_lightning.nerf.randomness import PointRandom, RayRandom
from nerf_lightning.nerf.types.rays import Points, RaggedSamples, RayBundle, RaySamples


def points_along(rays: RayBundle, samples: RaySamples, random: RayRandom | None, cones: bool = False) -> Points:
    """Return the midpoints of rays with equal numbers of samples: axes `*rays samples`.

    Args:
        rays: unit directions, scene units.
        samples: the samples along them.
        random: the step's random numbers for these rays.
        cones: whether the points carry the covariance of their pixel's cone, if rays know their pixel.
    """
    along = samples.midpoints[..., None] * rays.directions[..., None, :]
    count = samples.edges.shape[-1] - 1
    return Points(
        positions=rays.origins[..., None, :] + along,
        directions=rays.view_directions[..., None, :],
        photograph=None if rays.photograph is None else rays.photograph[..., None],
        random=None if random is None else random.along(count),
        covariance=_covariance(rays, samples, (..., None, slice(None))) if cones else None,
    )


def ragged_points(
    rays: RayBundle, samples: RaggedSamples, random: RayRandom | None, cones: bool = False, first: int = 0
) -> Points:
    """Return the midpoints of ragged samples, along one axis.

    The arguments are those of `points_along`; `first` is the index of each ray's first sample on its ray.
    """
    ray = samples.ray_index

    def of_ray(each: Tensor) -> Tensor:
        return each.index_select(0, ray)

    of_points = None
    if random is not None:
        of_points = PointRandom(of_ray(random.key), of_ray(random.slots), first + samples.sample_index)
    along = samples.midpoints[:, None] * of_ray(rays.directions)
    return Points(
        positions=of_ray(rays.origins) + along,
        directions=of_ray(rays.view_directions),
        photograph=None if rays.photograph is None else of_ray(rays.photograph),
        random=of_points,
        covariance=_covariance(rays, samples, ray) if cones else None,
    )


def _covariance(rays: RayBundle, samples: RaySamples | RaggedSamples, ray_of: Any) -> Tensor | None:
    if rays.pixel_side is None:
        return None
    side, growth = rays.pixel_side[ray_of].unbind(dim=-1)
    # Without gradients: the shape of its cone is no reason to move a camera.
    return cone_covariance(rays.directions[ray_of].detach(), samples.deltas, side + growth * samples.midpoints)

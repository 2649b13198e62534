"""From rays and their samples to the points that a field is asked about, in both layouts."""

from nerf_lightning.nerf.randomness import PointRandom, RayRandom
from nerf_lightning.nerf.types.points import Points
from nerf_lightning.nerf.types.rays import PackedSamples, RayBundle, RaySamples


def points_along(rays: RayBundle, samples: RaySamples, random: RayRandom | None) -> Points:
    """Return the midpoints of rays that have equally many samples: axes `*rays samples`."""
    along = samples.midpoints[..., None] * rays.directions[..., None, :]
    count = samples.edges.shape[-1] - 1
    return Points(
        positions=rays.origins[..., None, :] + along,
        directions=rays.view_directions[..., None, :],
        photograph=None if rays.photograph is None else rays.photograph[..., None],
        random=None if random is None else random.along(count),
    )


def packed_points(rays: RayBundle, samples: PackedSamples, random: RayRandom | None) -> Points:
    """Return the midpoints of packed samples: one axis."""
    ray = samples.ray_index
    along = samples.midpoints[:, None] * rays.directions[ray]
    return Points(
        positions=rays.origins[ray] + along,
        directions=rays.view_directions[ray],
        photograph=None if rays.photograph is None else rays.photograph[ray],
        random=None if random is None else PointRandom(random.key[ray], random.slots[ray], samples.place),
    )

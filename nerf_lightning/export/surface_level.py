"""Which density counts as the surface: one that rays meet where rendering sees a surface."""

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.checkpoints import SceneRecord
from nerf_lightning.geometry.cameras import rays_through_pixels
from nerf_lightning.models.levels import RadianceModel
from nerf_lightning.models.weighted_renderings import weighted_renderings
from nerf_lightning.randomness import fold
from nerf_lightning.rendering.ray_statistics import median_distances
from nerf_lightning.types.rays import PixelIndex, RayBundle

# So many rays of the training views are asked.
RAYS = 1 << 13
# Rays that stop less light than this have met no surface.
OPAQUE = 0.9
# Where four fifths of the rays end it is denser than the level. At the median, thin and grazed surfaces have holes;
# much lower, surfaces swell.
QUANTILE = 0.2


def surface_level(model: RadianceModel, record: SceneRecord, tile_points: int) -> float | None:
    """Return the density (per scene unit) at the surface, or None where no ray meets one in the scene's box.

    Rays of the training views are rendered; where each opaque one has half of its light behind it the field is asked
    for its density. Their first fifth puts the mesh where the pictures see the surface, and leaves few holes.
    """
    rays = _some_rays(record)
    if not rays.near.numel():
        return None
    seen = torch.cat(list(_surface_points(model, rays, record, tile_points)))
    seen = seen[((seen >= record.aabb[0]) & (seen <= record.aabb[1])).all(dim=-1)]
    if not len(seen):
        return None
    device = next(model.parameters()).device
    density = torch.cat([model.last.density(part.to(device)).cpu() for part in seen.split(tile_points)])
    density = density[density > 0]  # on the very edge of an empty cell there may be none
    return float(density.quantile(QUANTILE)) if len(density) else None


def _some_rays(record: SceneRecord) -> RayBundle:
    generator = torch.Generator().manual_seed(0)
    train = torch.tensor(record.splits["train"])
    view = train[torch.randint(len(train), (RAYS,), generator=generator)]
    x, y = (
        (torch.rand(RAYS, generator=generator, dtype=torch.float64) * size[view]).long()
        for size in (record.cameras.width, record.cameras.height)
    )
    rays = rays_through_pixels(record.cameras, PixelIndex(view, x, y), record.near, record.far)
    return rays[(rays.far > rays.near).nonzero()[:, 0]]


def _surface_points(
    model: RadianceModel, rays: RayBundle, record: SceneRecord, tile_points: int
) -> Iterator[Float[Tensor, "points 3"]]:
    rays, key = rays.to(next(model.parameters()).device), fold(0, "surface")
    for part, renderings in weighted_renderings(model, rays, record.background, key, tile_points):
        at = part.origins + median_distances(renderings[-1], part)[:, None] * part.directions
        yield at[renderings[-1].opacity > OPAQUE].cpu()

"""Which density counts as the surface: one that rays meet where rendering sees a surface."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.checkpoints import SceneRecord
from nerf_lightning.evaluation.geometry import surface_depth
from nerf_lightning.geometry.cameras import rays_through_pixels
from nerf_lightning.models.levels import RadianceModel
from nerf_lightning.models.pictures import render_rays
from nerf_lightning.types.rays import PixelIndex

# So many rays of the training views are asked.
RAYS = 1 << 13
# Rays that stop less light than this have met no surface.
OPAQUE = 0.9
# Where three quarters of them end it is denser than the level. At the median, thin and grazed surfaces have holes;
# below the first quartile, surfaces swell.
QUANTILE = 0.25


def surface_level(model: RadianceModel, record: SceneRecord, tile_points: int) -> float | None:
    """Return the density (per scene unit) at the surface, or None where no ray meets one in the scene's box.

    Rays of the training views are rendered; at the expected depth of each opaque one the field is asked for its
    density. Their first quartile puts the surface of the mesh where the depth of the pictures is, and leaves few holes.
    """
    seen = _surface_points(model, record, tile_points)
    seen = seen[((seen >= record.aabb[0]) & (seen <= record.aabb[1])).all(dim=-1)]
    if not len(seen):
        return None
    device = next(model.parameters()).device
    density = torch.cat([model.last.density(part.to(device)).cpu() for part in seen.split(tile_points)])
    # Where a ray's light ends partly before and partly behind empty space, there is nothing at the mean.
    density = density[density > 0]
    return float(density.quantile(QUANTILE)) if len(density) else None


def _surface_points(model: RadianceModel, record: SceneRecord, tile_points: int) -> Float[Tensor, "points 3"]:
    generator = torch.Generator().manual_seed(0)
    train = torch.tensor(record.splits["train"])
    view = train[torch.randint(len(train), (RAYS,), generator=generator)]
    x, y = (
        (torch.rand(RAYS, generator=generator, dtype=torch.float64) * size[view]).long()
        for size in (record.cameras.width, record.cameras.height)
    )
    rays = rays_through_pixels(record.cameras, PixelIndex(view, x, y), record.near, record.far)
    _, depth, opacity, *_ = render_rays(model, rays, record.background, tile_points)
    at = rays.origins + surface_depth(depth, opacity, rays.far)[:, None] * rays.directions
    return at[opacity > OPAQUE]

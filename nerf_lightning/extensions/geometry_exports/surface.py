"""The density of the surface, and the colors of its points as seen from the photographs' cameras."""

from typing import Literal

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from nerf_lightning.export.base import Report
from nerf_lightning.nerf.geometry.cameras import rays_through_pixels
from nerf_lightning.nerf.models.base import Model, point_field
from nerf_lightning.nerf.models.tiles import tiles, weighted_renderings
from nerf_lightning.nerf.randomness import fold
from nerf_lightning.nerf.rendering.quadrature import composite
from nerf_lightning.nerf.rendering.ray_statistics import median_distances
from nerf_lightning.nerf.types.rays import PixelIndex, Points, RayBundle, RaySamples
from nerf_lightning.nerf.types.renderings import DenseRendering
from nerf_lightning.nerf.types.scene import SceneRecord
from nerf_lightning.visualization.pictures import to_bytes

RAYS = 1 << 13  # Number of rays of the training views that are used.
# Rays with lower opacity are left out. This is not `min_opacity`, below which nothing is exported: the level is a
# quantile, of rays that have certainly met a surface.
OPAQUE = 0.9
# Four fifths of the rays end at a density above the level. At the median, thin and grazed surfaces have holes; much
# lower, surfaces swell.
QUANTILE = 0.2


def surface_level(model: Model, record: SceneRecord, tile_points: int) -> float | None:
    """Return the density (per scene unit) at the surface; None if no ray hits one in the scene's box.

    Rays of the training views are rendered; the field's density is evaluated where each opaque one has lost half of its
    light. The first quintile of these densities puts the mesh where the pictures see the surface, and leaves few holes.
    """
    device = next(model.parameters()).device
    rays, points = _some_rays(record).to(device), []
    if not rays.near.numel():
        return None
    for part, renderings in weighted_renderings(model, rays, record.background, fold(0, "surface"), tile_points):
        at = part.origins + median_distances(renderings[-1], part)[:, None] * part.directions
        points.append(at[renderings[-1].opacity > OPAQUE].cpu())
    seen = torch.cat(points)
    seen = seen[((seen >= record.aabb[0]) & (seen <= record.aabb[1])).all(dim=-1)]
    if not len(seen):
        return None
    density = torch.cat([point_field(model).density(part.to(device)).cpu() for part in seen.split(tile_points)])
    density = density[density > 0]  # it may be 0 on the very edge of an empty cell
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


SeenFrom = Literal["cameras", "normal"]
SAMPLES = 8  # Per short ray.


def surface_colors(
    model: Model,
    record: SceneRecord,
    points: Float[Tensor, "points 3"],
    normals: Float[Tensor, "points 3"],
    reach: float,
    seen_from: SeenFrom,
    tile_points: int,
    report: Report,
) -> UInt8[Tensor, "points 3"]:
    """Return the color of each surface point (scene's frame), from the last level.

    A ray of length twice `reach` (scene units) passes through each. `normal` looks straight at the surface, against its
    unit outward normal; `cameras` from the training cameras that face it most directly, and so along trained
    directions.
    """
    device = next(model.parameters()).device
    eyes = record.cameras.c2w[list(record.splits["train"]), :, 3]
    colors = torch.zeros(len(points), 3, dtype=torch.uint8)
    for part in tiles(len(points), max(1, tile_points // SAMPLES)):
        at, normal = points[part], normals[part]
        looks = -normal[None] if seen_from == "normal" else looks_from_facing(at, normal, eyes)
        ways, here = looks.to(device), at.to(device)
        rgb = [short_rays(model, here, look, reach, reach, SAMPLES, closed=True).rgb for look in ways]
        colors[part] = to_bytes(torch.stack(rgb).mean(dim=0))
        report("colors", part.stop / max(1, len(points)))
    return colors


def short_rays(
    model: Model,
    points: Float[Tensor, "points 3"],
    directions: Float[Tensor, "points 3"],
    before: float,
    after: float,
    samples: int,
    closed: bool,
) -> DenseRendering:
    """Return what rays along unit directions see from `before` points to `after` them, using only the last level.

    Everything is in the scene's frame and units; `closed` says whether the remaining light ends there, or continues.
    """
    edges = torch.linspace(0.0, before + after, samples + 1, device=points.device).expand(len(points), samples + 1)
    intervals, origins = RaySamples(edges), points - before * directions
    positions = origins[:, None] + intervals.midpoints[..., None] * directions[:, None]
    output = point_field(model).query(Points(positions, directions[:, None]))
    near, beyond = torch.zeros(len(points), device=points.device), None if closed else torch.zeros_like(points)
    return composite(output, intervals, RayBundle(origins, directions, near, near + before + after, directions), beyond)


NEAREST = 3  # Cameras per point.
PAIRS = 1 << 20  # All vectors from points to cameras would take gigabytes: this many of 36 bytes are held at a time.


def looks_from_nearest(
    points: Float[Tensor, "points 3"], eyes: Float[Tensor, "cameras 3"]
) -> Float[Tensor, "looks points 3"]:
    """Return unit directions to each point from the cameras nearest to it."""
    parts = []
    for part in tiles(len(points), max(1, PAIRS // len(eyes))):
        away = points[part, None] - eyes
        parts.append(_chosen(away, -away.norm(dim=-1)))
    return functional.normalize(torch.cat(parts, dim=1), dim=-1)


def looks_from_facing(
    points: Float[Tensor, "points 3"], normals: Float[Tensor, "points 3"], eyes: Float[Tensor, "cameras 3"]
) -> Float[Tensor, "looks points 3"]:
    """Return unit directions to each point from the cameras that its unit normal faces most directly."""
    parts = []
    for part in tiles(len(points), max(1, PAIRS // len(eyes))):
        away = functional.normalize(points[part, None] - eyes, dim=-1)
        parts.append(_chosen(away, -(away * normals[part, None]).sum(dim=-1)))
    return torch.cat(parts, dim=1)


def _chosen(away: Float[Tensor, "points cameras 3"], score: Float[Tensor, "points cameras"]) -> Tensor:
    best = score.topk(min(NEAREST, away.shape[1]), dim=-1).indices
    return torch.stack([away[torch.arange(len(away)), each] for each in best.T])

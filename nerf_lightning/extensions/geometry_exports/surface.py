"""Which density counts as the surface, and which color its points have, looked at from the photographs' cameras."""

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
from nerf_lightning.nerf.types.points import Points
from nerf_lightning.nerf.types.rays import PixelIndex, RayBundle, RaySamples
from nerf_lightning.nerf.types.renderings import DenseRendering
from nerf_lightning.nerf.types.scene import SceneRecord
from nerf_lightning.visualization.pictures import to_bytes

RAYS = 1 << 13  # So many rays of the training views are asked.
OPAQUE = 0.9  # Rays that stop less light than this have met no surface.
# Where four fifths of the rays end it is denser than the level. At the median, thin and grazed surfaces have holes;
# much lower, surfaces swell.
QUANTILE = 0.2


def surface_level(model: Model, record: SceneRecord, tile_points: int) -> float | None:
    """Return the density (per scene unit) at the surface, or None where no ray meets one in the scene's box.

    Rays of the training views are rendered; where each opaque one has half of its light behind it the field is asked
    for its density. Their first fifth puts the mesh where the pictures see the surface, and leaves few holes.
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


SeenFrom = Literal["cameras", "normal"]
SAMPLES = 8  # Of a short ray.


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
    """Return the color of each point on the surface, in the scene's frame, as the last level has it.

    A ray of twice `reach` (scene units) passes each. `normal` looks straight at the surface, against its unit outward
    normal; `cameras` from the training cameras that face it most squarely, and so along directions that were learned.
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
    at: Float[Tensor, "points 3"],
    look: Float[Tensor, "points 3"],
    before: float,
    behind: float,
    samples: int,
    closed: bool,
) -> DenseRendering:
    """Return what rays along unit directions see from `before` points to `behind` them, by the last level alone.

    All is in the scene's frame and units; `closed` says whether the light that is left ends there, or goes on.
    """
    edges = torch.linspace(0.0, before + behind, samples + 1, device=at.device).expand(len(at), samples + 1)
    intervals, origins = RaySamples(edges), at - before * look
    positions = origins[:, None] + intervals.midpoints[..., None] * look[:, None]
    output = point_field(model).query(Points(positions, look[:, None]))
    near, beyond = torch.zeros(len(at), device=at.device), None if closed else torch.zeros_like(at)
    return composite(output, intervals, RayBundle(origins, look, near, near + before + behind, look), beyond)


NEAREST = 3  # Cameras that are taken of each point.
PAIRS = 1 << 20  # The ways of all points to all cameras would take gigabytes: so many are held at a time, of 36 bytes.


def looks_from_nearest(
    points: Float[Tensor, "points 3"], eyes: Float[Tensor, "cameras 3"]
) -> Float[Tensor, "looks points 3"]:
    """Return unit directions to each point from the cameras that stand nearest to it."""
    parts = []
    for part in tiles(len(points), max(1, PAIRS // len(eyes))):
        away = points[part, None] - eyes
        parts.append(_chosen(away, -away.norm(dim=-1)))
    return functional.normalize(torch.cat(parts, dim=1), dim=-1)


def looks_from_facing(
    points: Float[Tensor, "points 3"], normals: Float[Tensor, "points 3"], eyes: Float[Tensor, "cameras 3"]
) -> Float[Tensor, "looks points 3"]:
    """Return unit directions to each point from the cameras that its unit normal points at most squarely."""
    parts = []
    for part in tiles(len(points), max(1, PAIRS // len(eyes))):
        away = functional.normalize(points[part, None] - eyes, dim=-1)
        parts.append(_chosen(away, -(away * normals[part, None]).sum(dim=-1)))
    return torch.cat(parts, dim=1)


def _chosen(away: Float[Tensor, "points cameras 3"], score: Float[Tensor, "points cameras"]) -> Tensor:
    best = score.topk(min(NEAREST, away.shape[1]), dim=-1).indices
    return torch.stack([away[torch.arange(len(away)), each] for each in best.T])

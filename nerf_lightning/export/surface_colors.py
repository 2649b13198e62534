"""Colours of points on a surface: a short ray through each is rendered."""

from typing import Literal

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nerf_lightning.checkpoints import SceneRecord
from nerf_lightning.export.lattice import Report
from nerf_lightning.export.looks import looks_from_facing
from nerf_lightning.export.pictures import to_bytes
from nerf_lightning.models.levels import RadianceModel
from nerf_lightning.models.tiles import tiles
from nerf_lightning.rendering.quadrature import composite
from nerf_lightning.types.rays import RayBundle, RaySamples

SeenFrom = Literal["cameras", "normal"]
# Of a short ray.
SAMPLES = 8


def surface_colors(
    model: RadianceModel,
    record: SceneRecord,
    points: Float[Tensor, "points 3"],
    normals: Float[Tensor, "points 3"],
    reach: float,
    seen_from: SeenFrom,
    tile_points: int,
    report: Report,
    stage: str = "colours",
) -> UInt8[Tensor, "points 3"]:
    """Return the colour of each point.

    Args:
        model: its last level is asked.
        record: of the scene.
        points: on the surface, scene frame.
        normals: unit, outward.
        reach: half the length of a ray, scene units.
        seen_from: `normal` looks straight at the surface; `cameras` from the training cameras that face it most
            squarely, and so along directions that were learnt.
        tile_points: most points that go through the field at once.
        report: told how much is done.
        stage: under this name.
    """
    device = next(model.parameters()).device
    eyes = record.cameras.c2w[list(record.splits["train"]), :, 3]
    colors = torch.zeros(len(points), 3, dtype=torch.uint8)
    for part in tiles(len(points), max(1, tile_points // SAMPLES)):
        at, normal = points[part], normals[part]
        looks = -normal[None] if seen_from == "normal" else looks_from_facing(at, normal, eyes)
        rgb = [_short_rays(model, at.to(device), look.to(device), reach) for look in looks]
        colors[part] = to_bytes(torch.stack(rgb).mean(dim=0))
        report(stage, part.stop / max(1, len(points)))
    return colors


def _short_rays(model: RadianceModel, at: Tensor, look: Tensor, reach: float) -> Float[Tensor, "points 3"]:
    # From before the surface to behind it; what light is left then ends there.
    edges = torch.linspace(0.0, 2.0 * reach, SAMPLES + 1, device=at.device).expand(len(at), SAMPLES + 1)
    samples, origins = RaySamples(edges), at - reach * look
    positions = origins[:, None] + samples.midpoints[..., None] * look[:, None]
    output = model.last.field(positions, look[:, None], None)
    near = torch.zeros(len(at), device=at.device)
    rays = RayBundle(origins, look, near, near + 2.0 * reach, torch.zeros_like(near, dtype=torch.int64), look)
    return composite(output, samples, rays, None).rgb

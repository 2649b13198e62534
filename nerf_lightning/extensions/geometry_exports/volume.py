"""Density and color on a regular grid over the scene's box."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray
from torch import Tensor

from nerf_lightning.export.base import MODEL_ALONE, Export, Report, RunContext, refuse_ndc, require_free
from nerf_lightning.extensions.geometry_exports.density_grid import Lattice, require_resolution, sample_density
from nerf_lightning.extensions.geometry_exports.surface import looks_from_nearest
from nerf_lightning.files.atomic import whole_file
from nerf_lightning.files.json_files import write_json
from nerf_lightning.messages.console import StageProgress
from nerf_lightning.nerf.geometry.world_frame import unit_of
from nerf_lightning.nerf.models.base import Model, point_field
from nerf_lightning.nerf.models.tiles import tiles
from nerf_lightning.nerf.types.rays import Points
from nerf_lightning.nerf.types.scene import SceneRecord
from nerf_lightning.visualization.pictures import to_bytes

BYTES_PER_POINT = 12  # Density, color, and the density again in the user's units.
LEAST_ALPHA = 1e-3  # A cell less opaque than this has no color.
COSTS = {"density": 2.0, "colors": 3.0}


@dataclass
class VolumeExport(Export):
    """Write `volume.npz` (density, rgb) and `volume.json`, which describes the grid's position.

    Args:
        resolution: cells along the longest side of the box.
    """

    resolution: int = 128

    def export(
        self, model: Model, record: SceneRecord, folder: Path, tile_points: int, run: RunContext = MODEL_ALONE
    ) -> list[Path]:
        """Write the grids."""
        refuse_ndc(record, "volume")
        arrays, about = folder / "volume.npz", folder / "volume.json"
        require_free(files=[arrays, about])
        lattice = require_resolution(record, self.resolution, BYTES_PER_POINT)
        with StageProgress(COSTS) as report:
            density = sample_density(model, lattice, tile_points, report)
            rgb = _colors(model, record, lattice, density, tile_points, report)
        unit = unit_of(record.to_user.double())
        with whole_file(arrays) as part:
            np.savez_compressed(part, density=density / np.float32(unit), rgb=rgb)
        write_json(about, _described(record, lattice))
        return [arrays, about]


def _described(record: SceneRecord, lattice: Lattice) -> dict[str, object]:
    to_scene = torch.eye(4, dtype=torch.float64)
    to_scene[:3, :3] *= lattice.spacing
    to_scene[:3, 3] = lattice.lower
    return {
        "scene": record.name,
        "shape": list(lattice.shape),
        "index_to_user": (record.to_user.double() @ to_scene).tolist(),
        "spacing": lattice.spacing * unit_of(record.to_user.double()),
        "density": "float32 (x, y, z), per unit of length of the capture",
        "rgb": "uint8 (x, y, z, 3), sRGB, seen from the nearest cameras; 0 where a cell is transparent",
        "space": record.space,
    }


def _colors(
    model: Model,
    record: SceneRecord,
    lattice: Lattice,
    density: Float[ndarray, "x y z"],
    tile_points: int,
    report: Report,
) -> UInt8[ndarray, "x y z 3"]:
    rgb = np.zeros((lattice.num_points, 3), np.uint8)
    densities = density.reshape(-1)
    eyes = record.cameras.c2w[list(record.splits["train"]), :, 3]
    for chunk in lattice.chunks():
        visible = -np.expm1(-densities[chunk] * lattice.spacing) > LEAST_ALPHA
        kept = torch.from_numpy(np.flatnonzero(visible))
        points = lattice.points(chunk)[kept]
        parts = [_point_colors(model, points[part], eyes) for part in tiles(len(points), tile_points)]
        rgb[chunk.start + kept.numpy()] = torch.cat(parts).numpy()
        report("colors", chunk.stop / lattice.num_points)
    return rgb.reshape(*lattice.shape, 3)


def _point_colors(
    model: Model, points: Float[Tensor, "points 3"], eyes: Float[Tensor, "cameras 3"]
) -> UInt8[Tensor, "points 3"]:
    device, looks = next(model.parameters()).device, looks_from_nearest(points, eyes)
    query = point_field(model).query
    colors = [query(Points(points.to(device), look.to(device))).rgb.cpu() / len(looks) for look in looks]
    return to_bytes(sum(colors, torch.zeros(len(points), 3)))

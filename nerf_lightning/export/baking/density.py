"""Where a model has density: the box that holds it, and its values on a lattice over that box."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.ndimage import binary_dilation
from torch import Tensor

from nerf_lightning.compute.machine import require_memory
from nerf_lightning.export.baking.contraction import Contraction, is_place, num_values
from nerf_lightning.export.density_grid import CHUNK, Lattice, Report, sample_density
from nerf_lightning.export.voxel_kernels.layout import SIDE, any_in_blocks
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import for_terminal
from nerf_lightning.nerf.models.base import Model, point_field
from nerf_lightning.nerf.models.tiles import tiles
from nerf_lightning.nerf.types.scene import SceneRecord

FIRST = 96  # Cells along the longest side of the first look.
STRIDE = 4  # The second look is at every fourth voxel.
DEEPEST = 4.0  # Of voxels in normalized device coordinates, in sides of a pixel.
LEAST_OPTICAL = 0.01  # A voxel that stops less of the light holds nothing.
# The optical depths and three masks; and about a hundred bytes for each voxel near a surface, of which there are few.
BYTES_PER_VOXEL = 20
MORE_BYTES = 16  # Without bounds the light that is stopped, too: of each half of the rays, together, and in order.


@dataclass(frozen=True)
class DensityGrid:
    """Optical depths, at lower + spacing (i, j, k); each side is a multiple of a block's."""

    lower: Float[Tensor, "3"]
    spacing: Float[Tensor, "3"]
    optical: Float[ndarray, "x y z"]
    """Along a way as long as the longest side of a voxel."""
    contraction: Contraction | None = None
    """Of a scene without bounds, whose contracted cube is what the grid lies in."""

    def places(self, voxels: Int[ndarray, "voxels 3"]) -> Float[Tensor, "voxels 3"]:
        """Return where voxels lie, scene frame."""
        places = self._in_grid(voxels)
        return places if self.contraction is None else self.contraction.world(places)

    def lengths(self, voxels: Int[ndarray, "voxels 3"]) -> Float[ndarray, "voxels"]:
        """Return how long voxels are, scene units; 0 where the grid holds no place of the scene."""
        longest = float(self.spacing.max())
        if self.contraction is None:
            return np.full(len(voxels), longest, np.float32)
        places = self._in_grid(voxels)
        length = self.contraction.half * longest * self.contraction.radius(places).square()
        return (length * is_place(places)).numpy()

    def _in_grid(self, voxels: Int[ndarray, "voxels 3"]) -> Float[Tensor, "voxels 3"]:
        return (self.lower + self.spacing * torch.from_numpy(voxels)).float()


def density_grid(model: Model, record: SceneRecord, resolution: int, tile_points: int, report: Report) -> DensityGrid:
    """Return the densities over what there is in a scene's box, `resolution` voxels along its longest side."""
    contraction = Contraction.of(record) if record.space == "contracted" else None
    box = None if contraction is not None else _box_of_content(model, record, tile_points, report)

    def sides_of(count: int) -> tuple[Float[Tensor, "3"], tuple[int, int, int]]:
        if box is None:
            return torch.full((3,), 4.0 / num_values(count), dtype=torch.float64), (num_values(count),) * 3
        sides = (box[1] - box[0]).double()
        spacing = depths_of_voxels(record) * sides[:2].max() / count if record.space == "ndc" else sides.max() / count
        spacing = spacing.expand(3)
        x, y, z = (SIDE * int(-(-float(a) // (SIDE * float(b))) or 1) for a, b in zip(sides, spacing, strict=True))
        return spacing, (x, y, z)

    def bytes_of(count: int) -> int:
        x, y, z = sides_of(count)[1]
        return (BYTES_PER_VOXEL + MORE_BYTES * (contraction is not None)) * x * y * z

    spacing, shape = sides_of(resolution)
    require_memory(
        f"what.resolution={resolution} makes a grid of {' x '.join(map(str, shape))} voxels",
        resolution,
        bytes_of,
        lambda count: f"what.resolution={count}",
    )
    middle_to_lower = 0.5 * spacing * (torch.tensor(shape) - 1)
    lower = torch.full((3,), -2.0) if box is None else box.double().mean(dim=0) - middle_to_lower
    grid = DensityGrid(lower, spacing, np.zeros(shape, np.float32), contraction)
    _fill(model, grid, tile_points, report)
    if not (grid.optical > LEAST_OPTICAL).any():
        raise InputError(_nothing(record))
    return grid


def depths_of_voxels(record: SceneRecord) -> Float[Tensor, "3"]:
    """Return the sides of a voxel in normalized device coordinates, those of a pixel being 1.

    One is as deep as it takes for the photographs from either end to show it at a place that is off by one pixel from
    where those from the middle do. In these coordinates a place z moves by (1 - z) / 2 times the camera's way times a,
    the focal length in halves of the image.
    """
    assert record.cameras.ndc is not None
    centers = record.cameras.c2w[:, :, 3]
    ways = (centers - centers.mean(dim=0)).norm(dim=-1).max().clamp(min=1e-6)
    deep = 2.0 / float(ways * record.cameras.ndc[0].max())
    return torch.tensor([1.0, 1.0, min(max(deep, 1.0), DEEPEST)], dtype=torch.float64)


def _box_of_content(model: Model, record: SceneRecord, tile_points: int, report: Report) -> Float[Tensor, "2 3"]:
    lattice = Lattice.over(record.aabb, FIRST)
    density = sample_density(model, lattice, tile_points, report, "box")
    # A voxel is finer than the cells of this look by half at least.
    found = np.argwhere(density * (0.5 * lattice.spacing) > LEAST_OPTICAL)
    if not len(found):
        raise InputError(_nothing(record))
    corners = np.stack([found.min(axis=0) - 1, found.max(axis=0) + 1]).astype(np.float64)
    inside = torch.from_numpy(corners) * lattice.spacing + lattice.lower
    return torch.stack([inside[0].maximum(record.aabb[0].double()), inside[1].minimum(record.aabb[1].double())])


def _nothing(record: SceneRecord) -> str:
    return (
        f"There is nothing to export: the model of {for_terminal(record.name)} has no density anywhere in the scene's "
        "box. Train longer, or correct the box (scene.aabb_half) and train again."
    )


def _fill(model: Model, grid: DensityGrid, tile_points: int, report: Report) -> None:
    """Ask for the densities of the blocks in or beside which the second look has found something."""
    sides = [-(-side // STRIDE) for side in grid.optical.shape]
    found = _asked(model, grid, STRIDE * np.argwhere(np.ones(sides, bool)).astype(np.int32), tile_points, report)
    candidates = any_in_blocks(dilated((found > LEAST_OPTICAL).reshape(sides)), SIDE // STRIDE)  # within a stride
    corner = SIDE * np.argwhere(candidates).astype(np.int32)
    within = np.argwhere(np.ones((SIDE,) * 3, bool)).astype(np.int32)
    for part in tiles(len(corner), max(1, CHUNK // SIDE**3)):
        voxels = (corner[part, None] + within).reshape(-1, 3)
        grid.optical[tuple(voxels.T)] = _asked(model, grid, voxels, tile_points)
        report("density", part.stop / max(1, len(corner)))


def _asked(
    model: Model, grid: DensityGrid, voxels: Int[ndarray, "voxels 3"], tile_points: int, report: Report | None = None
) -> Float[ndarray, "voxels"]:
    device = next(model.parameters()).device
    optical = np.empty(len(voxels), np.float32)
    for part in tiles(len(voxels), tile_points):
        density = point_field(model).density(grid.places(voxels[part]).to(device)).cpu().numpy()
        optical[part] = grid.lengths(voxels[part]) * density
        if report is not None:
            report("coarse", part.stop / len(voxels))
    return optical


def dilated(mask: Bool[ndarray, "x y z"]) -> Bool[ndarray, "x y z"]:
    """Return the mask with all neighbors, those across edges and corners among them."""
    grown: Bool[ndarray, "x y z"] = binary_dilation(mask, np.ones((3, 3, 3), bool))
    return grown

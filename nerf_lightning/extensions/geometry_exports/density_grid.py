"""A regular grid of points over a scene's box, and the model's density at them."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from nerf_lightning.compute.machine import require_memory
from nerf_lightning.export.base import Report
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.models.base import Model, point_field
from nerf_lightning.nerf.models.tiles import tiles
from nerf_lightning.nerf.types.scene import SceneRecord

CHUNK = 1 << 18  # Points whose coordinates are held at a time; progress is reported after each chunk.


@dataclass(frozen=True)
class Lattice:
    """Points at lower + spacing * (i, j, k)."""

    lower: Float[Tensor, "3"]
    spacing: float
    """Scene units, the same along all axes."""
    shape: tuple[int, int, int]

    @classmethod
    def over(cls, aabb: Float[Tensor, "2 3"], resolution: int) -> "Lattice":
        """Return the lattice that divides the longest side of a box into `resolution` cells, and covers all of it.

        >>> Lattice.over(torch.tensor([[0.0, 0, 0], [4, 2, 1]]), 4).shape
        (5, 3, 2)
        """
        sides = (aabb[1] - aabb[0]).double()
        spacing = float(sides.max()) / resolution
        cells = torch.ceil(sides / spacing - 1e-6).long()
        lower = aabb.double().mean(dim=0) - 0.5 * spacing * cells
        x, y, z = (int(count) + 1 for count in cells)
        return cls(lower, spacing, (x, y, z))

    @property
    def num_points(self) -> int:
        """Number of points."""
        return math.prod(self.shape)

    def points(self, part: slice) -> Float[Tensor, "points 3"]:
        """Return the points numbered from `part.start` to `part.stop`; the last axis varies fastest."""
        index = torch.arange(part.start, part.stop)
        _, y, z = self.shape
        cell = torch.stack([index // (y * z), index // z % y, index % z], dim=-1)
        return (self.lower + self.spacing * cell).float()

    def to_scene(self, index: Float[ndarray, "points 3"]) -> Float[ndarray, "points 3"]:
        """Return the positions of fractional indices (i, j, k)."""
        return (self.lower.numpy() + self.spacing * index).astype(np.float32)

    def chunks(self) -> Iterator[slice]:
        """Yield all points in parts of a convenient size."""
        return tiles(self.num_points, CHUNK)


def sample_density(
    model: Model, lattice: Lattice, tile_points: int, report: Report, stage: str = "density"
) -> Float[ndarray, "x y z"]:
    """Return the density (per scene unit) that rendering sees at the points of a lattice."""
    device = next(model.parameters()).device
    density = np.empty(lattice.num_points, np.float32)
    for chunk in lattice.chunks():
        points = lattice.points(chunk)
        parts = [point_field(model).density(points[part].to(device)).cpu() for part in tiles(len(points), tile_points)]
        density[chunk] = torch.cat(parts).numpy()
        report(stage, chunk.stop / lattice.num_points)
    return density.reshape(lattice.shape)


def require_resolution(record: SceneRecord, resolution: int, bytes_per_point: int) -> Lattice:
    """Return the lattice over the scene's box; refuse fewer than 2 cells, or more than fit into memory."""
    if resolution < 2:
        raise InputError(f"what.resolution={resolution}: give the number of cells along the longest side, 2 or more.")
    lattice = Lattice.over(record.aabb, resolution)
    require_memory(
        f"what.resolution={resolution} makes a grid of {' x '.join(map(str, lattice.shape))} points",
        resolution,
        lambda cells: bytes_per_point * Lattice.over(record.aabb, cells).num_points,
        lambda cells: f"what.resolution={max(2, cells)}",
    )
    return lattice

"""Learnt features on a multiresolution hash grid (Sec. 3, arXiv 2201.05989)."""

import psutil
import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerf_lightning.errors import InputError
from nerf_lightning.nerf.encoders.base import Encoder
from nerf_lightning.nerf.kernels.hash_grid.interpolate import interpolate
from nerf_lightning.nerf.kernels.hash_grid.layout import hash_grid_layout
from nerf_lightning.nerf.ranges import require_ranges

INITIAL_RANGE = 1e-4
# Weights, gradients and Adam's two moments, in float32.
BYTES_PER_PARAMETER = 16
MOST_LEVELS = 64
FINEST = 1 << 24
"""Cells that float32 tells apart."""


class HashGridEncoder(Encoder):
    """Concatenate the features that trilinear interpolation finds in grids of growing resolution.

    Points lie in the unit cube; a field that maps its positions there is needed (`field=hash`). A level whose
    vertices fit into its table is dense; a finer one shares entries by a hash, and training sorts out the collisions.

    Args:
        num_levels: grids.
        features_per_level: features of a vertex.
        log2_table_size: most entries of a level, as a power of two.
        min_resolution: cells along a side of the coarsest grid.
        max_resolution: of the finest; about the scene's size over its smallest detail.

    Raises:
        InputError: training the tables would not fit into the machine's memory.
    """

    needs_unit_cube = True

    def __init__(
        self,
        num_levels: int = 8,
        features_per_level: int = 4,
        log2_table_size: int = 18,
        min_resolution: int = 16,
        max_resolution: int = 512,
    ):
        super().__init__()
        if not 1 <= min_resolution <= max_resolution or num_levels < 1 or features_per_level < 1:
            raise ValueError("1 <= min_resolution <= max_resolution, and at least one level and feature are needed")
        if num_levels > MOST_LEVELS:
            raise ValueError(f"num_levels={num_levels}: give {MOST_LEVELS} at most")
        require_ranges(locals(), {"log2_table_size": (1, 30), "max_resolution": (1, FINEST)})
        self.layout = hash_grid_layout(num_levels, log2_table_size, min_resolution, max_resolution)
        self.features_per_level = features_per_level
        _require_memory(self.layout.offsets[-1] * features_per_level)
        self.table = nn.Parameter(torch.empty(self.layout.offsets[-1], features_per_level))
        self.reset_parameters()

    @property
    def out_dim(self) -> int:
        """Levels times features."""
        return len(self.layout.resolutions) * self.features_per_level

    def forward(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points features"]:
        """Return the features, coarsest level first."""
        return self._interpolate(points, None)

    def tables(self) -> list[nn.Parameter]:
        """Return the one table, in which all levels lie."""
        return [self.table]

    def attach_gradients(
        self, points: Float[Tensor, "*points 3"], features: Float[Tensor, "*points features"]
    ) -> Float[Tensor, "*points features"]:
        """Return the features of points, with gradients, where they have been computed without them before."""
        return self._interpolate(points, features.reshape(-1, self.out_dim))

    def _interpolate(self, points: Tensor, known: Tensor | None) -> Tensor:
        return interpolate(self.table, points.reshape(-1, 3), self.layout, known).view(*points.shape[:-1], self.out_dim)

    def reset_parameters(self) -> None:
        """Draw the tables anew: uniform within 1e-4, as the paper has it."""
        nn.init.uniform_(self.table, -INITIAL_RANGE, INITIAL_RANGE)


def _require_memory(num_parameters: int) -> None:
    needed, there = BYTES_PER_PARAMETER * num_parameters, psutil.virtual_memory().total
    if needed > 0.8 * there:
        raise InputError(
            f"encoder=hash_grid: its tables have {num_parameters:,} parameters, and training them takes "
            f"{needed / 2**30:.1f} GiB (weights, gradients, Adam's moments) of the {there / 2**30:.1f} GiB of this "
            "machine. Lower encoder.log2_table_size (one less halves it), encoder.num_levels or "
            "encoder.features_per_level."
        )

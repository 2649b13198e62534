"""The grid of an occupancy sampler: where its cells are, and what is known of each.

`occupancy.py` chooses which cells are updated, and when; the numbers are in conf/sampler/occupancy.yaml.
"""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.messages.errors import ANOTHER, InputError
from nerf_lightning.nerf.geometry.boxes import center_and_half, require_box
from nerf_lightning.nerf.kernels.march.grid import BLOCK, OccupancyCells, blocks_of, leaps_over
from nerf_lightning.nerf.part import Part
from nerf_lightning.nerf.randomness import batch_random, fold
from nerf_lightning.nerf.samplers.base import DensityFn

CELLS_AT_ONCE = 1 << 18


class OccupancyGrid(Part):
    """Cells in a box, numbered z fastest."""

    aabb: Tensor
    """Lower and upper corner of the box."""
    range: Tensor
    """Near and far of the scene."""
    density: Tensor
    """A decaying maximum of the density found in each cell."""
    possible: Tensor
    """Which cells may ever hold something."""
    cells: Tensor
    """1 where occupied."""
    blocks: Tensor
    """1 where any cell of a block is occupied."""
    leaps: Tensor
    """Distance to the next such block. A recorded step reads it at a fixed address: write to it, never replace it."""

    def __init__(self, resolution: int) -> None:
        super().__init__()
        self.resolution = resolution
        self.register_buffer("aabb", torch.tensor([[-1.0] * 3, [1.0] * 3]))
        self.register_buffer("range", torch.tensor([0.0, 1.0]))

        side, blocks = (resolution,) * 3, (resolution // BLOCK,) * 3
        self.register_buffer("density", torch.zeros(side))
        self.register_buffer("possible", torch.ones(side, dtype=torch.bool))
        self.register_buffer("cells", torch.ones(side, dtype=torch.uint8))
        self.register_buffer("blocks", torch.ones(blocks, dtype=torch.uint8))
        self.register_buffer("leaps", torch.zeros(blocks, dtype=torch.uint8), persistent=False)

    def validate_state(self) -> None:
        """Check the loaded state.

        Raises:
            InputError: an empty box, or cells that are neither empty nor occupied.
        """
        require_box(self.aabb)
        near, far = self.range.tolist()
        sound = 0.0 <= near < far and float(self.cells.max()) <= 1 and bool((self.density >= 0).all())
        if not sound or not torch.equal(self.blocks, blocks_of(self.cells)):
            raise InputError(f"The occupancy grid in the model's state cannot be one. {ANOTHER}")

    def occupied(self) -> OccupancyCells:
        """Return the currently occupied cells, for a march."""
        return OccupancyCells(self.aabb, self.cells, self.leaps)

    def reset_parameters(self) -> None:
        """Reset the grid: every possible cell is occupied."""
        self.density.zero_()
        self.occupy(self.possible)

    def update(self, density: DensityFn, number: Int[Tensor, "cells"], key: int, decay: float) -> None:
        """Evaluate the field at a random point in some cells; each keeps the larger of its decayed and its new value.

        Args:
            density: the field's density.
            number: indices of the cells.
            key: key of this step's random numbers.
            decay: factor on a cell's previous value.
        """
        kept = self.density.view(-1)
        within = batch_random(fold(key, "occupancy_grid"), number.shape[0], number.device).uniform("cell", 3)
        for cells, part in zip(number.split(CELLS_AT_ONCE), within.split(CELLS_AT_ONCE), strict=True):
            kept[cells] = torch.maximum(decay * kept[cells], density(self.positions(cells, part)).float())

    def prune(self, least_density: float) -> None:
        """Keep occupied the cells that are denser than half the mean of the possible cells, or than `least_density`."""
        mean = self.density.sum() / self.possible.sum()
        self.occupy((self.density > (0.5 * mean).clamp(max=least_density)) & self.possible)

    def occupy(self, occupied: Tensor) -> None:
        """Set the cells that rays may not skip."""
        self.cells.copy_(occupied)
        self.blocks.copy_(blocks_of(self.cells))
        self.leaps.copy_(leaps_over(self.blocks))

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        super()._load_from_state_dict(*args, **kwargs)
        self.leaps.copy_(leaps_over(self.blocks))

    def positions(self, number: Int[Tensor, "cells"], within: Float[Tensor, "#cells 3"]) -> Float[Tensor, "cells 3"]:
        """Return points in cells; `within` is the position in each, from 0 to 1 along its sides."""
        side = self.resolution
        cell = torch.stack([number // side**2, number // side % side, number % side], dim=-1)
        return self._from_cells(cell + within)

    def cell_centers(self) -> tuple[Float[Tensor, "cells 3"], float]:
        """Return the centers of the cells, and half the diagonal of a cell."""
        along = torch.arange(self.resolution, device=self.aabb.device)[:, None] + 0.5
        axes = self._from_cells(along).unbind(dim=-1)
        half_diagonal = 0.5 * float((self.aabb[1] - self.aabb[0]).norm()) / self.resolution
        return torch.stack(torch.meshgrid(*axes, indexing="ij")).view(3, -1).t(), half_diagonal

    def _from_cells(self, coordinates: Tensor) -> Tensor:
        """Return positions that are given in cells from the lower corner of the box."""
        center, half = center_and_half(self.aabb)
        return center + (2.0 * coordinates / self.resolution - 1.0) * half

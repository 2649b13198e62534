"""What a march walks through: occupied cells, blocks of them, and how far each ray is."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from nerf_lightning.nerf.types.tensor_struct import TensorStruct

BLOCK = 4
"""Side of the blocks of cells that are skipped at once where all are empty."""


OPAQUE = 12.0
"""Optical depth, by the floor of the cells' densities, behind which nothing is kept."""


@dataclass(frozen=True)
class OccupancyCells(TensorStruct):
    """Which cells may hold something."""

    aabb: Float[Tensor, "2 3"]
    """The box of cascade 0."""
    cells: UInt8[Tensor, "cascades x y z"]
    """1 where occupied."""
    blocks: UInt8[Tensor, "cascades a b c"]
    """1 where any cell of a block is."""
    floor: Float[Tensor, "cascades x y z"]
    """About the smallest density in each cell: a march ends where so much matter lies before it that nothing behind
    can be seen, even by this cautious guess."""


def blocks_of(cells: UInt8[Tensor, "cascades x y z"]) -> UInt8[Tensor, "cascades a b c"]:
    """Return which blocks of cells hold an occupied one; the grid's side is a multiple of 4."""
    return torch.nn.functional.max_pool3d(cells.float(), BLOCK).to(torch.uint8)


@dataclass(frozen=True)
class March(TensorStruct):
    """Where each ray's march stands: rays may be marched a few samples at a time."""

    enter: Float[Tensor, "rays"]
    """Distances between which samples are wanted."""
    leave: Float[Tensor, "rays"]
    jitter: Float[Tensor, "rays"]
    """In [0, 1)."""
    next: Int[Tensor, "rays"]
    """The lattice interval to go on with."""

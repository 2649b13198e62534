"""What a march walks through: occupied cells, blocks of them, and the state of each ray."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn import functional

from nerf_lightning.nerf.geometry.boxes import center_and_half
from nerf_lightning.nerf.types.rays import RayBundle
from nerf_lightning.nerf.types.tensor_struct import TensorStruct

BLOCK = 4
"""Side of the blocks of cells that are skipped at once if all are empty."""
FARTHEST = 8
"""Maximum number of blocks that are skipped at once."""


@dataclass(frozen=True)
class OccupancyCells(TensorStruct):
    """Which cells may hold something."""

    aabb: Float[Tensor, "2 3"]
    """The box that contains the cells."""
    cells: UInt8[Tensor, "x y z"]
    """1 where occupied."""
    leaps: UInt8[Tensor, "a b c"]
    """The result of `leaps_over` for each block of cells: how much around it is empty."""

    def in_box(self, rays: RayBundle) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays 3"]]:
        """Return origins and directions in coordinates where the box is the cube from -1 to 1."""
        center, half = center_and_half(self.aabb)
        return (rays.origins - center) / half, rays.directions / half


def blocks_of(cells: UInt8[Tensor, "x y z"]) -> UInt8[Tensor, "a b c"]:
    """Return which blocks contain an occupied cell; the grid's side must be a multiple of 4."""
    return functional.max_pool3d(cells.float()[None], BLOCK)[0].to(torch.uint8)


def leaps_over(blocks: UInt8[Tensor, "a b c"]) -> UInt8[Tensor, "a b c"]:
    """Return the Chebyshev distance from each block to the nearest occupied one, in blocks.

    0 for an occupied block, 1 for a neighbor, at most `FARTHEST`.
    """
    reached = blocks.float()[None]
    leaps = torch.zeros_like(reached)
    for _ in range(FARTHEST):
        leaps += 1.0 - reached
        reached = functional.max_pool3d(reached, 3, stride=1, padding=1)
    return leaps[0].to(torch.uint8)


@dataclass(frozen=True)
class MarchState(TensorStruct):
    """The state of each ray's march: rays may be marched a few samples at a time."""

    enter: Float[Tensor, "rays"]
    """Distances between which samples are taken."""
    leave: Float[Tensor, "rays"]
    jitter: Float[Tensor, "rays"]
    """In [0, 1)."""
    next: Int[Tensor, "rays"]
    """The lattice interval to continue with."""


class GridMarch(NamedTuple):
    """A march through a grid, for kernels that do all of it."""

    state: MarchState
    lattice: Float[Tensor, "edges"]
    """Increasing distances; two more than there are intervals."""
    cells: OccupancyCells

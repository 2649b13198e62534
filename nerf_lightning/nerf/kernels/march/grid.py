"""What a march walks through: occupied cells, blocks of them, and how far each ray is."""

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
"""Side of the blocks of cells that are skipped at once where all are empty."""
FARTHEST = 8
"""So many blocks on are skipped at once, at most."""


@dataclass(frozen=True)
class OccupancyCells(TensorStruct):
    """Which cells may hold something."""

    aabb: Float[Tensor, "2 3"]
    """The box that holds them."""
    cells: UInt8[Tensor, "x y z"]
    """1 where occupied."""
    leaps: UInt8[Tensor, "a b c"]
    """What `leaps_over` says of each block of cells: how much around it is empty."""

    def in_box(self, rays: RayBundle) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays 3"]]:
        """Return origins and directions in coordinates of the box, which is the cube from -1 to 1."""
        center, half = center_and_half(self.aabb)
        return (rays.origins - center) / half, rays.directions / half


def blocks_of(cells: UInt8[Tensor, "x y z"]) -> UInt8[Tensor, "a b c"]:
    """Return which blocks of cells hold an occupied one; the grid's side is a multiple of 4."""
    return functional.max_pool3d(cells.float()[None], BLOCK)[0].to(torch.uint8)


def leaps_over(blocks: UInt8[Tensor, "a b c"]) -> UInt8[Tensor, "a b c"]:
    """Return how far from each block the next occupied one is, in blocks along the axis where it is farthest.

    0 for a block that is occupied, 1 for a neighbor, `FARTHEST` at most.
    """
    reached = blocks.float()[None]
    leaps = torch.zeros_like(reached)
    for _ in range(FARTHEST):
        leaps += 1.0 - reached
        reached = functional.max_pool3d(reached, 3, stride=1, padding=1)
    return leaps[0].to(torch.uint8)


@dataclass(frozen=True)
class MarchState(TensorStruct):
    """Where each ray's march stands: rays may be marched a few samples at a time."""

    enter: Float[Tensor, "rays"]
    """Distances between which samples are wanted."""
    leave: Float[Tensor, "rays"]
    jitter: Float[Tensor, "rays"]
    """In [0, 1)."""
    next: Int[Tensor, "rays"]
    """The lattice interval to go on with."""


class GridMarch(NamedTuple):
    """A march through a grid, for kernels that do all of it."""

    state: MarchState
    lattice: Float[Tensor, "edges"]
    """Increasing distances; two more than there are intervals."""
    cells: OccupancyCells

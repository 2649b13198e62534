"""Blocks: a grid of values cut into cubes, of which those are kept that hold something."""

from dataclasses import dataclass
from types import ModuleType

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.kernels.backends import backend, why_not

ROOM = "nerf_lightning.export.voxel_kernels"
SIDE = 8  # Values along a side of a block.
TILE = SIDE + 1
"""And with the border that the next blocks lend, so that every place of a block lies between values of its tile."""


@dataclass(frozen=True)
class VoxelBlocks:
    """A baked field as the kernels take it."""

    index: Int[ndarray, "x y z"]
    """The number of each block's tile, -1 where it is empty."""
    density: UInt8[ndarray, "blocks 9 9 9"]
    colors: UInt8[ndarray, "blocks 9 9 9 channels"]
    owner: Int[ndarray, "blocks 9 9 9"]
    """Which row of a table each value of a tile is of; -1: none."""
    scale: Float[ndarray, "numbers"]
    step: float
    outside: bool
    """Whether the grid is the contracted cube of a scene without bounds."""


@dataclass(frozen=True)
class Wanted:
    """Rays, in the grid as the kernels take them, and what they should meet."""

    origins: Float[ndarray, "rays 3"]
    directions: Float[ndarray, "rays 3"]
    looks: Float[ndarray, "rays basis"]
    lengths: Float[ndarray, "rays"]
    """As `bounded.march_tiles` takes them; outside, the distance at which each begins."""
    rgb: Float[ndarray, "rays 3"]
    behind: Float[ndarray, "rays 3"]
    """The colors of the background."""


def kernels(module: str, asked_by: str = "Baking", cure: str = "Reinstall numba.", room: str = ROOM) -> ModuleType:
    """Return a module of this folder (or of `room`), which must compile: without its kernels the work takes hours."""
    name = f"{room}.{module}"
    found = backend(name)
    if found is None:
        raise InputError(f"{asked_by} needs numba, which cannot be used here: {why_not(name)}. {cure}")
    return found


def any_in_blocks(mask: Bool[ndarray, "x y z"], side: int) -> Bool[ndarray, "bx by bz"]:
    """Return in which blocks of a side anything is true.

    >>> any_in_blocks(np.eye(4, dtype=bool)[None].repeat(2, 0), 2)[0].tolist()
    [[True, False], [False, True]]
    """
    pairs = [n for length in mask.shape for n in (length // side, side)]
    blocks: Bool[ndarray, "bx by bz"] = np.asarray(mask.reshape(pairs).any(axis=(1, 3, 5)))
    return blocks

"""Bricks: a grid of values cut into cubes, of which those are kept that hold something."""

from dataclasses import dataclass
from types import ModuleType

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from nerf_lightning.errors import InputError
from nerf_lightning.nerf.kernels.backends import twin, why_not

SIDE = 8
"""Values along a side of a brick."""
TILE = SIDE + 1
"""And with the border that the next bricks lend, so that every place of a brick lies between values of its tile."""


@dataclass(frozen=True)
class Bricks:
    """A baked field as the kernels take it."""

    index: Int[ndarray, "x y z"]
    """The number of each brick's tile, -1 where it is empty."""
    density: UInt8[ndarray, "bricks 9 9 9"]
    colors: UInt8[ndarray, "bricks 9 9 9 channels"]
    owner: Int[ndarray, "bricks 9 9 9"]
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
    """As `bricks.cpu.march_tiles` takes them; outside, the distance at which each begins."""
    rgb: Float[ndarray, "rays 3"]
    behind: Float[ndarray, "rays 3"]
    """The colours of the background."""


def kernels(module: str = "bricks.cpu") -> ModuleType:
    """Return the compiled kernels, of scenes in a box, `bricks.contracted`, or `bricks.gradients` of both.

    Without them, a page would take hours.

    Raises:
        InputError: they cannot be compiled here.
    """
    found = twin(module)
    if found is None:
        raise InputError(f"Baking needs numba, which cannot be used here: {why_not(module)}. Reinstall numba.")
    return found


def any_in_blocks(mask: Bool[ndarray, "x y z"], side: int) -> Bool[ndarray, "bx by bz"]:
    """Return in which blocks of a side anything is true.

    >>> any_in_blocks(np.eye(4, dtype=bool)[None].repeat(2, 0), 2)[0].tolist()
    [[True, False], [False, True]]
    """
    pairs = [n for length in mask.shape for n in (length // side, side)]
    blocks: Bool[ndarray, "bx by bz"] = np.asarray(mask.reshape(pairs).any(axis=(1, 3, 5)))
    return blocks

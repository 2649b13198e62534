"""Bricks: a grid of values cut into cubes, of which those are kept that hold something."""

from types import ModuleType

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from nerf_lightning.errors import InputError
from nerf_lightning.nerf.kernels.backends import twin, why_not

SIDE = 8
"""Values along a side of a brick."""
TILE = SIDE + 1
"""And with the border that the next bricks lend, so that every place of a brick lies between values of its tile."""


def kernels(module: str = "bricks.cpu") -> ModuleType:
    """Return the compiled kernels, of scenes in a box or `bricks.contracted`; without them, a page would take hours.

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

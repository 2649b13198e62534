"""Bricks: a grid of values cut into cubes, of which those are kept that hold something."""

from types import ModuleType

from nerf_lightning.errors import InputError
from nerf_lightning.nerf.kernels.backends import twin, why_not

SIDE = 8
"""Values along a side of a brick."""
TILE = SIDE + 1
"""And with the border that the next bricks lend, so that every place of a brick lies between values of its tile."""


def kernels() -> ModuleType:
    """Return the compiled kernels; without them, a page would take hours.

    Raises:
        InputError: they cannot be compiled here.
    """
    found = twin("bricks.cpu")
    if found is None:
        raise InputError(f"Baking needs numba, which cannot be used here: {why_not('bricks.cpu')}. Reinstall numba.")
    return found

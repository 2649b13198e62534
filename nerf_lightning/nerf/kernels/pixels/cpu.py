"""Local contrast for the CPU, bit-identical to `nerf.contrast.contrast`."""

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import UInt8
from numba import njit
from torch import Tensor

from nerf_lightning.nerf.contrast import FLAT, HIGHEST, SHIFT
from nerf_lightning.nerf.kernels.threads import over_rows


def contrast(rgba: UInt8[Tensor, "height width 4"]) -> UInt8[Tensor, "height width"]:
    """Return the shares of a picture's pixels."""
    out = torch.empty(rgba.shape[:2], dtype=torch.uint8)
    over_rows(_contrast, len(out), rgba.numpy(), FLAT, HIGHEST, SHIFT, out.numpy())
    return out


def trial() -> None:
    """Run every kernel once on tiny input; it raises whatever the compiler raises."""
    contrast(torch.zeros(1, 1, 4, dtype=torch.uint8))


@njit
@no_type_check
def _change(here, other, channel):
    if channel == 3:
        return 255 * abs(np.int64(here[3]) - np.int64(other[3]))
    return abs(np.int64(here[3]) * np.int64(here[channel]) - np.int64(other[3]) * np.int64(other[channel]))


@njit(nogil=True, cache=True)
@no_type_check
def _contrast(first, last, rgba, flat, highest, shift, out):
    height, width = rgba.shape[:2]
    for y in range(first, last):
        above, below = max(y - 1, 0), min(y + 1, height - 1)
        for x in range(width):
            left, right, most = max(x - 1, 0), min(x + 1, width - 1), np.int64(0)
            for c in range(4):
                here = rgba[y, x]
                change = _change(here, rgba[above, x], c) + _change(here, rgba[below, x], c)
                change += _change(here, rgba[y, left], c) + _change(here, rgba[y, right], c)
                most = max(most, change)
            out[y, x] = min((most >> shift) + flat, highest)

"""Which pixels of a photograph a mask keeps."""

from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, UInt8

from nerf_lightning.data.pixels.picture_files import read_rgba
from nerf_lightning.messages.errors import InputError

KEEP_ABOVE = 127
MOST_LEVELS = 16
"""Of green in a mask that is no cut-out photograph, at most."""
MaskColor = Literal["white", "black"]


def read_mask(path: Path, keep: MaskColor = "white", upright: bool = False) -> Bool[np.ndarray, "height width"]:
    """Return which pixels a picture keeps: the white ones or, where black is kept, the others.

    White is brighter than 127 of 255; of two values on one side of that the larger one is, and 1 alone is white.
    Where alpha, or red, is all that differs from pixel to pixel, it is the mask; of a cut-out photograph alpha is.

    Raises:
        InputError: what `read_rgba` refuses, and pictures with several channels that say different things.
    """
    rgba = read_rgba(path, upright, converts_colors=False)
    # Of red, green, blue and alpha, those that differ from pixel to pixel.
    said = [rgba[..., channel] for channel in range(4) if np.ptp(rgba[..., channel])]
    if np.ptp(rgba[..., 3]) and np.count_nonzero(np.bincount(rgba[..., 1].ravel())) > MOST_LEVELS:
        said = [rgba[..., 3]]
    said = said or [rgba[..., 0]]
    bright = [channel > _white_above(channel) for channel in said]
    if any((channel != bright[0]).any() for channel in bright[1:]):
        raise InputError(
            f"The mask {path} has colors or transparent pixels, so it is unclear which pixels it keeps. Save it as a "
            f"grayscale picture without alpha: {keep} is kept (scene.masks_keep), the other is left out."
        )
    return bright[0] if keep == "white" else ~bright[0]


def _white_above(channel: UInt8[np.ndarray, "height width"]) -> int:
    values = np.flatnonzero(np.bincount(channel.ravel()))
    if values[0] <= KEEP_ABOVE < values[-1]:
        return KEEP_ABOVE
    if len(values) == 2:
        return int(values[0])
    return 0 if values[-1] == 1 else KEEP_ABOVE

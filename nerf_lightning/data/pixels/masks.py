"""Read which pixels of a photograph a mask keeps.

Where masks are looked for: `captures/mask_files.py`.
"""

from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, UInt8

from nerf_lightning.data.pixels.picture_files import read_rgba
from nerf_lightning.messages.errors import InputError

KEEP_ABOVE = 127
MOST_LEVELS = 16
"""Maximum number of green levels in a mask that is not a cut-out photograph."""
MaskColor = Literal["white", "black"]


def read_mask(path: Path, keep: MaskColor = "white", upright: bool = False) -> Bool[np.ndarray, "height width"]:
    """Return which pixels a mask keeps: the white ones or, if black is kept, the others.

    White is brighter than 127 of 255; of two values on the same side of that, the larger one is white, and 1 alone is
    white. If only alpha, or red, differs between pixels, it is the mask; of a cut-out photograph alpha is.

    Raises:
        InputError: a picture that `read_rgba` refuses, or whose channels disagree.
    """
    rgba = read_rgba(path, upright, converts_colors=False)
    # Those of red, green, blue and alpha that differ between pixels.
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

"""The area filter that shrinks photographs and masks by a whole factor.

The factor is chosen in `captures/reader.py`.
"""

import numpy as np
from jaxtyping import Bool, UInt8

from nerf_lightning.messages.errors import InputError

PIXELS_AT_ONCE = 1 << 16
"""Number of pixels shrunk together: intermediate results fit into the cache."""
MOST_IN_32_BITS = (2**32 - 1) // (255 * (2 * 255 + 1))
"""Maximum number of pixels of a block whose weighted sums, doubled and rounded, fit into 32 bits."""


def downscaled_size(width: int, height: int, factor: int) -> tuple[int, int]:
    """Return (width, height) of a photograph shrunk by a whole factor that need not divide its size.

    The remainder at the right and at the bottom is cropped, so that focal length and principal point, which is measured
    from the upper left corner, are divided by exactly `factor`.

    >>> downscaled_size(1081, 720, 4)
    (270, 180)

    Raises:
        InputError: nothing is left.
    """
    if not min(width, height) >= factor >= 1:
        raise InputError(
            f"scene.downscale={factor} leaves nothing of a photograph of {width} x {height} pixels. "
            f"Choose a factor from 1 to {min(width, height)}."
        )
    return width // factor, height // factor


def crop_to_multiple(picture: UInt8[np.ndarray, "height width *c"], factor: int) -> UInt8[np.ndarray, "h w *c"]:
    """Return the picture without the remaining rows at the bottom and columns at the right."""
    height, width = (side // factor * factor for side in picture.shape[:2])
    return picture[:height, :width]


def whole_blocks(mask: Bool[np.ndarray, "height width"], factor: int) -> Bool[np.ndarray, "h w"]:
    """Return which blocks of `factor` x `factor` pixels are kept entirely; the rest of the picture is cropped."""
    height, width = (side // factor for side in mask.shape)
    blocks = mask[: height * factor, : width * factor].reshape(height, factor, width, factor)
    return np.asarray(blocks.all(axis=(1, 3)))


def area_downscale(
    rgba: UInt8[np.ndarray, "height width 4"], factor: int
) -> UInt8[np.ndarray, "small_height small_width 4"]:
    """Return the picture shrunk by a whole factor: each pixel is the mean of its block, premultiplied.

    color = sum(rgb * a) / sum(a), alpha = mean(a), both rounded to 8 bits (halves up) and kept straight;
    color is 0 where alpha is. The sums are integers, hence exact. `factor` must divide the size.
    """
    if factor == 1:
        return rgba
    height, width = rgba.shape[0] // factor, rgba.shape[1] // factor
    small = np.empty((height, width, 4), dtype=np.uint8)
    rows = max(1, PIXELS_AT_ONCE // (width * factor**2))
    for top in range(0, height, rows):
        small[top : top + rows] = _block_means(rgba[top * factor : (top + rows) * factor], factor)
    return small


def _block_means(rgba: UInt8[np.ndarray, "height width 4"], factor: int) -> UInt8[np.ndarray, "h w 4"]:
    height, width, area = rgba.shape[0] // factor, rgba.shape[1] // factor, factor**2
    blocks = rgba.reshape(height, factor, width, factor, 4)
    # Processing one pixel of each block at a time keeps the temporaries at the size of the small picture.
    parts = (blocks[:, row, :, column] for row in range(factor) for column in range(factor))
    total = np.zeros((height, width, 4), dtype=np.uint32 if area <= MOST_IN_32_BITS else np.uint64)
    if (rgba[..., 3] == 255).all():  # all weights are equal: the same means with a fraction of the work
        for part in parts:
            total += part
        return ((2 * total + area) // (2 * area)).astype(np.uint8)
    for part in parts:
        alpha = part[..., 3:].astype(np.uint32)
        total[..., :3] += part[..., :3] * alpha
        total[..., 3:] += alpha
    weight = total[..., 3:]
    small = np.empty((height, width, 4), dtype=np.uint8)
    small[..., :3] = (2 * total[..., :3] + weight) // np.maximum(2 * weight, 1)
    small[..., 3] = (2 * total[..., 3] + area) // (2 * area)
    small[small[..., 3] == 0] = 0
    return small

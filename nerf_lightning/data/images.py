"""Picture files to 8-bit RGBA with straight alpha, and the area filter that shrinks them."""

import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError

from nerf_lightning.errors import InputError

# A closed list: some of PIL's other decoders start outside programs.
FORMATS = ("PNG", "JPEG", "TIFF")
MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA")
ORIENTATION = 0x0112
DECODER_ERRORS = (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error)


def image_size(path: Path) -> tuple[int, int]:
    """Return (width, height) in pixels from the file's header; no pixel is decoded.

    Raises:
        InputError: the file is absent, empty, not a PNG, JPEG or TIFF, or too large to be decoded safely.
    """
    # PIL warns at 89 million pixels and fails at twice that; one limit is easier to explain than two.
    with warnings.catch_warnings():
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        with _opened(path) as image:
            return image.size


def read_rgba(path: Path) -> UInt8[np.ndarray, "height width 4"]:
    """Return a picture as RGBA with straight alpha; 255 where the file has none.

    Palettes and grey levels are expanded. Of 16-bit colour the upper byte is kept (less than one
    level off).

    Raises:
        InputError: unreadable or truncated, of a mode that has no such reading, or turned by an EXIF tag.
    """
    with _opened(path) as image:
        if image.mode not in MODES:
            raise InputError(
                f"{path} has the pixel mode {image.mode!r}, which has no plain reading as 8-bit colour. "
                "Save it as an 8-bit RGB or RGBA PNG."
            )
        try:
            image.load()
            turned = image.getexif().get(ORIENTATION, 1)
        except DECODER_ERRORS as error:
            raise InputError(_unreadable(path, error)) from error
        if turned != 1:
            raise InputError(
                f"{path} carries the EXIF orientation {turned}: it is stored turned or mirrored, so its "
                "pixels do not match its camera. Turn the pixels themselves and remove the tag (for example "
                "with `magick mogrify -auto-orient`), and estimate the cameras anew if they exist."
            )
        return np.asarray(image if image.mode == "RGBA" else image.convert("RGBA"))


def area_downscale(
    rgba: UInt8[np.ndarray, "height width 4"], factor: int
) -> UInt8[np.ndarray, "small_height small_width 4"]:
    """Return the picture shrunk by a whole factor: each pixel is the mean of its block, premultiplied.

    colour = sum(rgb * a) / sum(a), alpha = mean(a), both rounded to 8 bits (halves up) and kept straight;
    colour is 0 where alpha is. The sums are integers, hence exact. `factor` must divide the size.
    """
    if factor == 1:
        return rgba
    height, width = rgba.shape[0] // factor, rgba.shape[1] // factor
    blocks = rgba.reshape(height, factor, width, factor, 4)
    total = np.zeros((height, width, 4), dtype=np.uint64)
    # One pixel of each block at a time keeps the temporaries at the size of the small picture.
    for row in range(factor):
        for column in range(factor):
            part = blocks[:, row, :, column].astype(np.uint32)
            total[..., :3] += part[..., :3] * part[..., 3:]
            total[..., 3] += part[..., 3]
    weight, area = total[..., 3:], factor * factor
    small = np.empty((height, width, 4), dtype=np.uint8)
    small[..., :3] = (2 * total[..., :3] + weight) // np.maximum(2 * weight, 1)
    small[..., 3] = (2 * total[..., 3] + area) // (2 * area)
    small[small[..., 3] == 0] = 0
    return small


def _opened(path: Path) -> Image.Image:
    """Open the file and read its header."""
    try:
        return Image.open(path, formats=FORMATS)
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise InputError(
            f"{path} has more than {Image.MAX_IMAGE_PIXELS} pixels; more is not safe to decode. Shrink it first."
        ) from error
    except (UnidentifiedImageError, *DECODER_ERRORS) as error:
        raise InputError(_unreadable(path, error)) from error


def _unreadable(path: Path, error: Exception) -> str:
    """Say what is wrong with the file itself."""
    cure = "Copy or render it again; PNG, JPEG and TIFF are read."
    if path.is_file() and path.stat().st_size == 0:
        return f"{path} is empty (0 bytes). {cure}"
    if isinstance(error, UnidentifiedImageError):
        return f"{path} is not an image that can be read. {cure}"
    return f"{path} cannot be read: {error}. It is damaged or was cut short. {cure}"

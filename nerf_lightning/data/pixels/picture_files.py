"""Read picture files as 8-bit RGBA with straight alpha, and depth maps.

Which formats are read: `formats.py`. Whether EXIF orientation turns photographs: `captures/fit_to_pictures.py`, and
before poses are found, `sfm/photograph_folder.py`.
"""

import logging
import math
import mmap
import os
import re
import struct
import threading
import warnings
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from functools import cache
from io import BufferedReader
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image, ImageOps, UnidentifiedImageError

from nerf_lightning.data.pixels.color_profiles import to_srgb
from nerf_lightning.data.pixels.formats import HEIC_CURE, HEIC_ENDINGS, HEIC_KINDS, UNREAD, decoders
from nerf_lightning.files.budgets import limits, require_within
from nerf_lightning.files.numpy_files import read_npy
from nerf_lightning.files.regular import open_regular
from nerf_lightning.files.signatures import other_format
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.row_chunks import row_chunks

ENDINGS = (".png", ".jpg", ".jpeg", ".jfif", ".jpe", ".tif", ".tiff", ".webp", ".avif", *HEIC_ENDINGS)
MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK")
GREY_16 = ("I;16", "I;16B")
ORIENTATION = 0x0112
QUARTER_TURNS = (5, 6, 7, 8)
"""Orientations that swap width and height."""
JPEG_START, JPEG_BLOCK = b"\xff\xd8\xff", 64
"""Pixels of a block."""
JPEG_MARKER = re.compile(rb"\xff[\xc0-\xcf\xd9-\xfe]")
"""Markers with a length. Decoders skip the others, which have none: restarts among the pixels (0xd0 to 0xd7), TEM
(0x01), and what is not a marker."""
JPEGS = ("JPEG", "MPO")
"""Pillow's names: the latter contains further pictures behind its main one."""
ONE_PICTURE = (*JPEGS, "HEIF")
"""Formats of which only the main picture counts."""
JPEG_SCAN, JPEG_END = 0xDA, 0xD9
SOUND_SCANS, MOST_SCANS = 20, 100
"""Scans of a progressive file; each can be a few bytes, and costs a pass over all pixels."""
CURE = "Copy or render it again; PNG, JPEG, TIFF, WebP and AVIF are read."
DECODER_ERRORS = (
    *(OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error),
    *(TypeError, LookupError, ArithmeticError, AttributeError, RuntimeError, AssertionError),
)
"""Exceptions that PIL raises for damaged files, the latter ones by mistake."""

log = logging.getLogger(__name__)

# Python's list of warning filters is shared by all threads.
_filters = threading.Lock()
_saying = threading.Lock()
# Small files can announce large pictures, each of which takes gigabytes to decode.
LARGE = 40_000_000
_one_large_picture = threading.RLock()


class PictureHeader(NamedTuple):
    """The header of a picture file."""

    size: tuple[int, int]
    """(width, height) in pixels as stored."""
    orientation: int
    """EXIF orientation: 1 (as stored) to 8; 1 if there is no valid one."""


def read_header(path: Path) -> PictureHeader:
    """Return a picture's size and orientation; no pixel is decoded, and nothing behind a PNG's pixels is read.

    Raises:
        InputError: the file is missing, empty, of unknown format, too large to be decoded safely, contains several
            pictures, or has a pixel mode that does not convert to 8-bit color.
    """
    with opened_picture(path) as image:
        try:
            exif = image.getexif() if image.format != "PNG" or "exif" in image.info else {}
            orientation = exif.get(ORIENTATION, 1)
        except DECODER_ERRORS:
            orientation = 1
        return PictureHeader(image.size, orientation if isinstance(orientation, int) and 1 <= orientation <= 8 else 1)


def image_size(path: Path) -> tuple[int, int]:
    """Return (width, height) in pixels; see `read_header`."""
    return read_header(path).size


def is_heic(path: Path) -> bool:
    """Return whether a file begins like phones' HEIC photographs, whatever its name."""
    try:
        with open_regular(path, None) as file:
            start = file.read(12)
    except (OSError, InputError):
        return False
    return start[4:8] == b"ftyp" and start[8:12] in HEIC_KINDS


def read_rgba(path: Path, upright: bool = False, converts_colors: bool = True) -> UInt8[np.ndarray, "height width 4"]:
    """Return a picture as RGBA with straight alpha; 255 where the file has none.

    Palettes and gray levels are expanded, and colors are converted from the file's profile to sRGB. Of 16 bits the
    upper byte is kept (less than one level off). Both are logged once per folder.

    Args:
        path: the file.
        upright: rotate the pixels according to the EXIF tag; false returns them as stored.
        converts_colors: false keeps the numbers unchanged, as masks require.

    Raises:
        InputError: the file is refused by `read_header`, damaged or truncated.
    """
    with opened_picture(path) as image:
        if _is_deep(image):
            with _saying:
                _say_reduced(path.parent)
        try:
            image.load()
            if upright:
                image = ImageOps.exif_transpose(image)
        except DECODER_ERRORS as error:
            raise InputError(_unreadable(path, error)) from error
        rgba = np.empty((image.height, image.width, 4), np.uint8)
        convert = to_srgb(image, path.parent) if converts_colors else lambda part: part.convert("RGBA")
        for rows in row_chunks(*rgba.shape[:2]):  # otherwise several copies of the whole would be held at once
            part = image.crop((0, rows.start, image.width, rows.stop))
            if part.mode in GREY_16:  # in masks, whose numbers count, levels above 255 are white
                levels = np.asarray(part)
                part = Image.fromarray((levels >> 8 if converts_colors else levels.clip(max=255)).astype(np.uint8))
            rgba[rows] = np.asarray(convert(part))
        return rgba


def _is_deep(image: Image.Image) -> bool:
    """Return whether a picture that is not yet decoded has more than 8 bits per channel."""
    return ";16" in str(getattr(image, "tile", "")) or image.info.get("bit_depth", 8) > 8


@cache
def _say_reduced(folder: Path) -> None:
    log.info("%s: pictures with 16 bits per channel are read with the upper 8", folder)


def read_depth(path: Path) -> tuple[Float32[np.ndarray, "height width"], bool]:
    """Return a depth map as stored, and whether it counts levels, as sensors do, instead of lengths.

    It is a 16-bit gray picture, or an array (.npy), whose integers are levels. Invalid depths (NaN, infinity and
    negative numbers) become 0.

    Raises:
        InputError: the file is refused by `read_header`, damaged, or of another kind.
    """
    if path.suffix.lower() == ".npy":
        depth = np.squeeze(read_npy(path, CURE))
        if depth.ndim != 2 or depth.dtype.kind not in "fiu" or not depth.size:
            raise InputError(f"The depth map {path} is not an array of numbers, height by width. Save it again.")
        with np.errstate(over="ignore"):
            lengths = depth.astype(np.float32)
        return np.where(np.isfinite(lengths) & (lengths > 0), lengths, np.float32(0)), depth.dtype.kind != "f"
    with opened_picture(path) as image:
        if image.mode not in GREY_16:
            raise InputError(f"The depth map {path} is not a 16-bit grayscale picture. Save it as a 16-bit PNG.")
        try:
            return np.asarray(image).astype(np.float32), True
        except DECODER_ERRORS as error:
            raise InputError(_unreadable(path, error)) from error


class _JpegHeader(BufferedReader):
    """A JPEG's file that refuses to read a longer header than `budgets.image_header_bytes`."""

    def __init__(self, file: BufferedReader, path: Path):
        super().__init__(file.raw)
        self.remaining, self.path = float(limits().image_header_bytes), path
        self.seek(0)

    def read(self, size: int | None = -1, /) -> bytes:
        """Return the next bytes."""
        content = super().read(size)
        self.remaining -= len(content)
        if self.remaining < 0:
            require_within("image_header_bytes", math.inf, self.path, "bytes of header")
        return content


@contextmanager
def opened_picture(path: Path) -> Iterator[Image.Image]:
    """Open a picture file and read its header; no pixel is decoded.

    Raises:
        InputError: what `read_header` refuses.
    """
    if cure := UNREAD.get(path.suffix.lower()):
        raise InputError(f"{path} cannot be read. {cure}")
    with ExitStack() as opened:
        try:
            file = opened.enter_context(open_regular(path, "image", CURE))
            if file.peek(3).startswith(JPEG_START):  # Pillow concatenates its EXIF in quadratic time
                file = opened.enter_context(_JpegHeader(file, path))
            with _filters, warnings.catch_warnings():
                # PIL warns at a number of pixels and fails at twice that; a single limit is easier to explain.
                warnings.simplefilter("ignore", Image.DecompressionBombWarning)
                Image.MAX_IMAGE_PIXELS = limits().megapixels * 500_000
                image = opened.enter_context(Image.open(file, formats=decoders()))
        except Image.DecompressionBombError:
            require_within("megapixels", math.inf, path, "megapixels")
        except (UnidentifiedImageError, *DECODER_ERRORS) as error:
            raise InputError(_unreadable(path, error)) from error
        if isinstance(file, _JpegHeader):
            file.remaining = math.inf
        if image.format in JPEGS:
            _check_jpeg(image, file, path)
        _check_plain(image, path)
        with _one_large_picture if image.width * image.height > LARGE else nullcontext():
            yield image


def _check_jpeg(image: Image.Image, file: BufferedReader, path: Path) -> None:
    """Refuse a JPEG whose decoder would make up most of its pixels, or process them again and again."""
    width, height = image.size
    size = os.fstat(file.fileno()).st_size
    # It has at least one bit per block.
    if 8 * size * JPEG_BLOCK < width * height:
        raise InputError(
            f"{path} claims {width} x {height} pixels, and has {size:,} bytes: it is damaged or was cut short. {CURE}"
        )
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        scans = jpeg_scans(content)
    if scans > MOST_SCANS:
        raise InputError(
            f"{path} draws its pixels in {scans} passes, but intact files have at most {SOUND_SCANS}: it would take "
            f"hours to decode. {CURE}"
        )


def jpeg_scans(content: bytes | mmap.mmap) -> int:
    """Return the number of scans in a JPEG; what follows its end is not counted."""
    place, scans = 2, 0
    while found := JPEG_MARKER.search(content, place):
        marker, place = content[found.end() - 1], found.end()
        if marker == JPEG_END:
            break
        scans += marker == JPEG_SCAN
        place += int.from_bytes(content[place : place + 2], "big")
    return scans


def _check_plain(image: Image.Image, path: Path) -> None:
    """Refuse several pictures in one file, and pixel modes that are not 8-bit color."""
    # Extra pictures of a JPEG or HEIC (previews, depth) do not count; counting pages would read them all.
    if image.format not in ONE_PICTURE and getattr(image, "is_animated", False):
        raise InputError(
            f"{path} holds several pictures (an animation, or pages), and it is unclear which one is meant. Save each "
            "as a file of its own, for example with ffmpeg or `magick`, and name the one that belongs here."
        )
    if image.mode not in MODES + GREY_16:
        raise InputError(
            f"{path} has the pixel mode {image.mode!r}, which cannot be read unambiguously as 8-bit color. Save it as "
            "an 8-bit RGB or RGBA PNG."
        )


def _unreadable(path: Path, error: Exception) -> str:
    """Return what is wrong with the file itself."""
    if path.is_file() and path.stat().st_size == 0:
        return f"{path} is empty (0 bytes). {CURE}"
    if is_heic(path):
        cure = HEIC_CURE if "HEIF" not in decoders() else f"It cannot be decoded: {error}. {CURE}"
        return f"{path} is a photograph in the format HEIC. {cure}"
    if (other := other_format(path)) is not None:
        return f"{path} is {other}."
    if isinstance(error, UnidentifiedImageError):
        return f"{path} is not an image that can be read. {CURE}"
    return f"{path} cannot be read: {error}. It is damaged or was cut short. {CURE}"

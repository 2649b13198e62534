"""Pictures and films as part of a page: `data:` addresses, which load nothing."""

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from nerf_lightning.data.pixels.picture_files import read_rgba
from nerf_lightning.files.html import data_address
from nerf_lightning.files.regular import read_bytes
from nerf_lightning.messages.errors import InputError

LONGEST_SIDE = 1600
LOSSLESS_PIXELS = 1 << 18
"""Up to 512 x 512 pixels are kept exactly, larger pictures at `QUALITY`."""
QUALITY = 92
SMALL = 300


@dataclass(frozen=True)
class Embedded:
    """A picture in a page."""

    source: str
    width: int

    @property
    def is_small(self) -> bool:
        """Return whether it is shown larger than it is, where blurring would hide what is to be judged."""
        return self.width < SMALL


def embedded_file(path: Path) -> Embedded:
    """Return a picture file, decoded and encoded anew: nothing of the file but its pixels comes into the page."""
    return embedded(read_rgba(path)[..., :3])


def embedded(picture: UInt8[np.ndarray, "height width 3"]) -> Embedded:
    """Return a picture as WebP, shrunk where it is larger than a page."""
    image = Image.fromarray(np.ascontiguousarray(picture))
    width = image.width
    if max(image.size) > LONGEST_SIDE:
        image.thumbnail((LONGEST_SIDE, LONGEST_SIDE))
    lossless = image.width * image.height <= LOSSLESS_PIXELS
    buffer = io.BytesIO()
    image.save(buffer, format="WEBP", lossless=lossless, quality=QUALITY)
    return Embedded(data_address("image/webp", buffer.getvalue()), width)


def embedded_video(path: Path, most_bytes: int) -> str:
    """Return an mp4 as an address."""
    content = read_bytes(path, most_bytes, "Larger films need a larger max_megabytes.")
    if content[4:8] != b"ftyp":
        raise InputError(f"{path.name} is not an mp4")
    return data_address("video/mp4", content)

"""Make the plain background of photographs without alpha transparent."""

import hashlib
import logging
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from torch import Tensor

from nerf_lightning.data.captures.checks import known_background
from nerf_lightning.data.pixels.mapped_store import FORMAT, Header, MappedPixelStore, check_room, stored
from nerf_lightning.data.pixels.store import NOTICEABLE, in_threads
from nerf_lightning.messages.escaping import for_terminal
from nerf_lightning.nerf.geometry.subset import evenly_spaced_subset
from nerf_lightning.nerf.types.scene import UNSURE, Background, PixelStore

Color = tuple[int, int, int]

TOLERANCE = 2
"""Levels of 255 by which a pixel of the background may be off."""
EDGE_SHARE, VIEW_SHARE = 0.9, 0.9
"""Minimum share of a photograph's edge that has the color, and of photographs with such an edge."""
LEAST_SHARE = 0.1
"""Minimum share of the pixels in the background; less is a frame around the pictures."""
ALIKE = 0.9
"""Ratio of pixels transparent in all photographs to those in any: from here on it is a frame around the pictures."""
LOOKED_AT, THUMBNAIL = 32, 128

log = logging.getLogger(__name__)


def cut_out(pixels: PixelStore, name: str, wanted: bool) -> tuple[PixelStore, Color | None]:
    """Return the photographs with the plain background made transparent, and its color; unchanged if there is none.

    Pixels become transparent if they have the color and are connected to the picture's edge, so that content of the
    same color stays. Colors are not changed: over a background of that color the photographs look as before, to a level
    of 255. A store in memory is modified; for a mapped one another is made next to it.

    Args:
        pixels: of one scene.
        name: of the scene, for messages.
        wanted: false returns the photographs unchanged.
    """
    color = plain_color(pixels) if wanted else None
    if color is None:
        return pixels, None
    log.info(
        "%s: the object is on a plain %s background, which was made transparent (scene.cut_out=false keeps it)",
        for_terminal(name),
        in_words(color),
    )
    if isinstance(pixels, MappedPixelStore):
        parts = f"{pixels.path.stem} {pixels.header.checksum} {color} {TOLERANCE} {UNSURE}"
        base = pixels.path.with_name(hashlib.sha256(parts.encode()).hexdigest()[:24])
        return stored(base, None, partial(_write, pixels, color)), color
    for view in range(len(pixels.width)):
        rgba = pixels.view(view).numpy()
        rgba[..., 3] = _alpha(rgba, color)
    return replace(pixels, has_transparency=True), color


def in_words(color: Color) -> str:
    """Return a color in words.

    >>> in_words((255, 254, 255)), in_words((0, 0, 2)), in_words((90, 120, 90))
    ('white', 'black', 'rgb(90, 120, 90)')
    """
    if min(color) >= 255 - TOLERANCE:
        return "white"
    return "black" if max(color) <= TOLERANCE else f"rgb{color}"


def protocol_of(color: Color | None) -> dict[str, str]:
    """Return its entry in the protocol of measured numbers."""
    return {} if color is None else {"cut_out": in_words(color)}


def background_for(requested: str | None, color: Color | None, otherwise: Background) -> Background:
    """Return the `requested` background; None: `otherwise`, or what suits the color that was cut out.

    With a constant background, sheets of its color may grow in front of the content until nothing else is left; a
    random background per ray prevents them.
    """
    if requested is not None:
        return known_background(requested)
    if color is None:
        return otherwise
    suited: dict[str, Background] = {"white": "white_or_random", "black": "black_or_random"}
    return suited.get(in_words(color), "random")


def plain_color(pixels: PixelStore) -> Color | None:
    """Return the one color behind the content of all photographs; None if there is none.

    It is the color of nearly all edges. A frame that is the same in all photographs, such as a lens's dark rim or a
    film's black bars, is not a background; nor is anything in photographs with alpha or masks, whose authors have
    marked what counts.
    """
    if pixels.has_transparency or pixels.mask is not None:
        return None
    views = evenly_spaced_subset(range(len(pixels.width)), LOOKED_AT)
    edges = [_edge(pixels.view(view)) for view in views]
    usual = torch.stack([edge.median(dim=0).values for edge in edges]).median(dim=0).values
    red, green, blue = (int(level) for level in usual)
    shares = torch.tensor([float(_near(edge.numpy(), (red, green, blue)).mean()) for edge in edges])
    if float((shares >= EDGE_SHARE).float().mean()) < VIEW_SHARE:
        return None
    behind = torch.stack([_background_thumbnail(pixels, view, (red, green, blue)) for view in views])
    frame = behind.all(dim=0).sum() >= ALIKE * behind.any(dim=0).sum()
    return None if frame or float(behind.float().mean()) < LEAST_SHARE else (red, green, blue)


def _edge(rgba: UInt8[Tensor, "height width 4"]) -> UInt8[Tensor, "edge 3"]:
    return torch.cat([rgba[0], rgba[-1], rgba[:, 0], rgba[:, -1]])[:, :3]


def _near(rgb: np.ndarray, color: Color) -> np.ndarray:
    low = np.array([max(0, level - TOLERANCE) for level in color], dtype=np.uint8)
    high = np.array([min(255, level + TOLERANCE) for level in color], dtype=np.uint8)
    return np.asarray(((rgb >= low) & (rgb <= high)).all(axis=-1))


def _background_mask(plain: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Return which pixels have the plain color and are connected to the edge through such pixels."""
    from scipy import ndimage

    parts, count = ndimage.label(plain)
    reaches = np.zeros(count + 1, dtype=np.bool_)
    for side in (parts[0], parts[-1], parts[:, 0], parts[:, -1]):
        reaches[side] = True
    reaches[0] = False
    return np.asarray(reaches[parts])


def _background_thumbnail(pixels: PixelStore, view: int, color: Color) -> Bool[Tensor, "side side"]:
    rgba = pixels.view(view)
    rows, columns = (torch.linspace(0, side - 1, THUMBNAIL).round().long() for side in rgba.shape[:2])
    return torch.from_numpy(_background_mask(_near(rgba[rows][:, columns, :3].numpy(), color)))


def _alpha(rgba: UInt8[np.ndarray, "height width 4"], color: Color) -> UInt8[np.ndarray, "height width"]:
    """Return alpha: 0 behind the content, 255 within it, and `UNSURE` where a pixel may contain background.

    Pixels along the outline contain some; holes through the content show nothing else. Both may also be content of that
    color.
    """
    from scipy import ndimage

    plain = _near(rgba[..., :3], color)
    alpha = np.where(ndimage.binary_dilation(plain, np.ones((3, 3))), np.uint8(UNSURE), np.uint8(255))
    alpha[_background_mask(plain)] = 0
    return alpha


def _write(pixels: MappedPixelStore, color: Color, target: Path) -> Header:
    """Write the photographs with their alpha to the file `target`."""
    sizes = pixels.header.sizes
    check_room(target.parent, 4 * pixels.header.num_pixels)
    target.touch(mode=0o600)

    def write(view: int) -> None:
        rgba = pixels.view(view).numpy().copy()
        rgba[..., 3] = _alpha(rgba, color)
        with target.open("r+b") as file:
            file.seek(4 * int(pixels.offset[view]))
            file.write(rgba.data)

    in_threads(write, len(sizes), "Cutting out", visible=len(sizes) > NOTICEABLE)
    return Header(FORMAT, sizes, True, masked=False, contents=None, spots=0, checksum=0)

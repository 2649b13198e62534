"""Color profiles (ICC): convert pictures that phones and cameras save in other color spaces to sRGB."""

import io
import logging
import threading
from collections.abc import Callable
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
from PIL import Image, ImageCms

from nerf_lightning.messages.escaping import for_terminal

ROUNDING = 2
"""Levels of 255 by which a profile may differ from sRGB and still count as sRGB."""
MOST_BYTES = 1 << 22
"""Maximum size of a profile; those of screens and cameras have some kilobytes, and of printers a megabyte."""
LEVELS = np.linspace(0, 255, 9).round().astype(np.uint8)
MODES = {"1": "L", "L": "L", "LA": "L", "P": "RGB", "PA": "RGB", "RGB": "RGB", "RGBA": "RGB", "CMYK": "CMYK"}
"""The mode that profiles apply to, by the picture's mode."""

log = logging.getLogger(__name__)
_saying = threading.Lock()


def to_srgb(image: Image.Image, folder: Path) -> Callable[[Image.Image], Image.Image]:
    """Return a function that converts parts of a picture to RGBA in sRGB; alpha is kept.

    Conversions are logged once per folder. Unusable profiles are ignored.

    Args:
        image: the picture, decoded.
        folder: that of the picture, for the message.
    """
    profile, mode = image.info.get("icc_profile"), MODES.get(image.mode)
    is_known = mode is not None and isinstance(profile, bytes) and 0 < len(profile) <= MOST_BYTES
    name, transform = _transform(profile, mode) if is_known else ("", None)
    if transform is None or mode is None:
        if image.mode == "CMYK":
            _say(folder, "CMYK colors without a usable profile are converted to sRGB approximately")
        return lambda part: part if part.mode == "RGBA" else part.convert("RGBA")
    _say(folder, f"colors are converted from the profile {name} to sRGB")

    def convert(part: Image.Image) -> Image.Image:
        rgba = part.convert("RGBA")
        plain = rgba.convert("RGB") if mode == "RGB" else part.convert(mode)
        plain = ImageCms.applyTransform(plain, transform) or plain
        plain.putalpha(rgba.getchannel("A"))
        return plain

    return convert


@lru_cache(maxsize=8)
def _transform(profile: bytes, mode: str) -> tuple[str, ImageCms.ImageCmsTransform | None]:
    """Return a profile's name and its transform to sRGB; None if it is sRGB, damaged, or for other modes."""
    try:
        known = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        transform = ImageCms.buildTransform(known, ImageCms.createProfile("sRGB"), mode, "RGB")
        samples = Image.fromarray(_lattice(len(mode)), mode)
        changed = np.asarray(ImageCms.applyTransform(samples, transform)).astype(int)
        name = ImageCms.getProfileDescription(known).strip()
    except (ImageCms.PyCMSError, OSError, ValueError):
        return "", None
    is_srgb = mode != "CMYK" and np.abs(changed - np.asarray(samples.convert("RGB"))).max() <= ROUNDING
    return for_terminal(name) or "without a name", None if is_srgb else transform


def _lattice(channels: int) -> np.ndarray:
    colors = np.stack(np.meshgrid(*[LEVELS] * channels, indexing="ij"), axis=-1).reshape(1, -1, channels)
    return colors[..., 0] if channels == 1 else colors


def _say(folder: Path, what: str) -> None:
    with _saying:  # pictures are read by several threads
        _say_once(folder, what)


@cache
def _say_once(folder: Path, what: str) -> None:
    log.info("%s: %s", for_terminal(str(folder)), what)

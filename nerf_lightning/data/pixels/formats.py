"""Formats of picture files: the decoders that may be used, and what to do about formats that none of them reads.

Endings of pictures that are read: ENDINGS in `picture_files.py`.
"""

from functools import cache
from importlib import import_module

from PIL import features

FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "AVIF", "HEIF")
"""A closed list: some of PIL's other decoders start external programs."""
HEIC_ENDINGS = (".heic", ".heif", ".hif")
HEIC_KINDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
HEIC_CURE = (
    "HEIC, as phones save it, needs a decoder: pip install '.[heic]'. Or convert all of them to JPEG "
    "(`magick mogrify -format jpg *.heic`, or a phone's own export as JPEG, its setting 'most compatible'), and give "
    "their folder."
)
RAW_CURE = (
    "RAW is not read. Develop all of them with the same settings to JPEG or 16-bit TIFF (darktable, RawTherapee, or "
    "`magick mogrify -format jpg`), and give their folder."
)
EXR_CURE = (
    "OpenEXR holds linear light, which is not read. Convert all of them with the same exposure to PNG (`magick mogrify "
    "-colorspace sRGB -format png *.exr`), and give their folder."
)
UNREAD = dict.fromkeys((".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"), RAW_CURE) | {".exr": EXR_CURE}
"""Extensions, and what to do about such files. PIL reads most RAW files as TIFFs with only a small preview."""


@cache
def decoders() -> tuple[str, ...]:
    """Return those of FORMATS that are installed: AVIF comes with Pillow 11.3, HEIC with pi-heif or pillow-heif."""
    missing = set() if "avif" in features.modules and features.check("avif") else {"AVIF"}
    for name in ("pillow_heif", "pi_heif"):
        try:
            heif = import_module(name)
        except ImportError:
            continue
        # Only the picture, without thumbnails, depth maps and gain maps.
        heif.register_heif_opener(thumbnails=False, depth_images=False, aux_images=False)
        break
    else:
        missing.add("HEIF")
    return tuple(name for name in FORMATS if name not in missing)

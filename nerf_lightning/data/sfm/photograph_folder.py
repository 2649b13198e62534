"""Find and check photographs as they come from a camera, and put them upright next to the poses to be found."""

import logging
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from PIL import ExifTags, Image, ImageOps

from nerf_lightning.data.captures.left_out import LeftOut
from nerf_lightning.data.pixels.formats import HEIC_CURE, HEIC_ENDINGS, UNREAD, decoders
from nerf_lightning.data.pixels.picture_files import (
    DECODER_ERRORS,
    ORIENTATION,
    QUARTER_TURNS,
    image_size,
    opened_picture,
    read_rgba,
)
from nerf_lightning.files.budgets import require_within
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import is_plain, listed

READ_BY_COLMAP = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
WRITTEN_ANEW = (".webp", ".avif")
"""HEIC, too, if it is supported."""
PANORAMA = b"equirectangular"
"""The marker in XMP (Google's GPano:ProjectionType) that panorama cameras write."""
FEWEST = 3
SMALLEST_SIDE = 64
JPEG_QUALITY = 95
LENS_TAGS = (ExifTags.Base.FocalLength, ExifTags.Base.FocalLengthIn35mmFilm, ExifTags.Base.DigitalZoomRatio)
LONGEST_TAG = 200

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FoundPhotograph:
    """A picture file and its header; sizes in pixels, upright."""

    path: Path
    width: int
    height: int
    upright: bool
    """Whether the pixels are stored upright, not rotated by an EXIF tag."""
    is_panorama: bool
    """Whether it shows all directions, according to its header or `of_one_kind`."""
    lens: tuple[str, ...]
    """Camera, focal length and zoom from EXIF; empty strings if unknown."""
    has_alpha: bool = False

    @property
    def name(self) -> str:
        """Return its name next to the poses: with another extension if COLMAP does not read its format."""
        if self.path.suffix.lower() in READ_BY_COLMAP:
            return self.path.name
        return f"{self.path.name}.{'png' if self.has_alpha else 'jpg'}"

    @property
    def as_it_is(self) -> bool:
        """Return whether COLMAP reads the unmodified file upright."""
        return self.upright and self.name == self.path.name

    @property
    def camera(self) -> tuple[int, int, tuple[str, ...]]:
        """Return the key that photographs of one camera and zoom share; panoramas of one size all share it."""
        return self.width, self.height, () if self.is_panorama else self.lens


def find_photographs(folder: Path) -> list[FoundPhotograph]:
    """Return the photographs directly in a folder, sorted by name.

    Args:
        folder: contains them; it, and they, may be links.

    Raises:
        InputError: the folder does not exist, contains fewer than three pictures or more than the user allows, or one
            that is unreadable or tiny.
    """
    try:
        files, pictures = files_in(folder)
    except OSError as error:
        raise InputError(
            f"images={folder} is not a folder that can be read ({error.strerror or error}). "
            "Give the folder in which the photographs lie."
        ) from error
    odd = [path.name for path in pictures if not is_plain(path.name)]
    if odd:
        log.warning(
            "%d of %d photographs are left out because their names are not UTF-8 or contain control characters: %s. "
            "Rename them to use them.",
            *(len(odd), len(pictures), listed(odd, 5)),
        )
        pictures = [path for path in pictures if is_plain(path.name)]
    # A file next to a JPEG of the same name is its original.
    known = {path.stem.lower() for path in pictures}
    others = [path for path in files if path.stem.lower() not in known]
    heic = [path.name for path in others if path.suffix.lower() in HEIC_ENDINGS]
    if heic and "HEIF" not in decoders():
        raise InputError(f"images={folder} holds {listed(heic, 4)}. {HEIC_CURE}")
    if len(pictures) < FEWEST:
        raise InputError(_too_few(folder, pictures, files))
    if unread := [path for path in others if path.suffix.lower() in UNREAD]:
        cure = UNREAD[unread[0].suffix.lower()]
        log.warning("%d files are left out: %s. %s", len(unread), listed((path.name for path in unread), 3), cure)
    require_within("views", len(pictures), f"images={folder}", "photographs")
    left_out, photographs = LeftOut(f"images={folder}"), list[FoundPhotograph]()
    for path in pictures:
        with left_out.unless_usable(path.name):
            photographs.append(_photograph(path))
    left_out.require_enough(len(photographs))
    left_out.say(len(photographs))
    return photographs


def files_in(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return the files in a folder, sorted by name, and those that are photographs by their names.

    A HEIC, AVIF or WebP next to a JPEG, PNG or TIFF of the same name is its original, not another photograph.
    """
    files = sorted(path for path in folder.iterdir() if not path.name.startswith(".") and not path.is_dir())
    plain = {path.stem.lower() for path in files if path.suffix.lower() in READ_BY_COLMAP}
    anew = (*WRITTEN_ANEW, *HEIC_ENDINGS) if "HEIF" in decoders() else WRITTEN_ANEW

    def is_photograph(path: Path) -> bool:
        ending = path.suffix.lower()
        return ending in READ_BY_COLMAP or (ending in anew and plain.isdisjoint((path.stem.lower(), path.name.lower())))

    return files, [path for path in files if is_photograph(path)]


def put_upright(photograph: FoundPhotograph, folder: Path) -> None:
    """Put a photograph into a folder as a hard link, or a copy if that is impossible; re-encode a rotated one.

    Also re-encode one in a format that COLMAP does not read.
    """
    target = folder / photograph.name
    if not photograph.as_it_is:
        _write_anew(photograph.path, target)
        return
    try:
        os.link(photograph.path.resolve(), target)
    except OSError:
        shutil.copyfile(photograph.path, target)


def check_pixels(photograph: FoundPhotograph) -> None:
    """Decode a photograph once, so that a damaged one is reported before hours are spent on the others."""
    if photograph.as_it_is:
        read_rgba(photograph.path)


def _photograph(path: Path) -> FoundPhotograph:
    width, height = image_size(path)
    if min(width, height) < SMALLEST_SIDE:
        raise InputError(
            f"{path} is {width} x {height} pixels: too small to find details in it. Remove thumbnails and icons from "
            f"the folder; a photograph needs at least {SMALLEST_SIDE} pixels on its shorter side."
        )
    turned, is_panorama, lens, has_alpha = _said_of(path)
    # Orientations 5 to 8 are quarter turns.
    size = (height, width) if turned in QUARTER_TURNS else (width, height)
    return FoundPhotograph(path, *size, turned == 1, is_panorama, lens, has_alpha)


def _said_of(path: Path) -> tuple[object, bool, tuple[str, ...], bool]:
    """Return a photograph's orientation, whether it is a panorama, what identifies its lens, and if it has alpha."""
    with opened_picture(path) as image:
        try:
            # Pillow would decode a whole PNG to find EXIF behind its pixels.
            exif = image.getexif() if image.format != "PNG" or "exif" in image.info else Image.Exif()
            # For a TIFF, this reads the file.
            details = exif.get_ifd(ExifTags.IFD.Exif)
        except DECODER_ERRORS:
            exif, details = Image.Exif(), {}  # damage is reported when the pixels are decoded
        xmp = image.info.get("xmp", b"")
        is_panorama = PANORAMA in (xmp if isinstance(xmp, bytes) else str(xmp).encode())
        has_alpha = image.has_transparency_data
    lens = (exif.get(ExifTags.Base.Model, ""), *(details.get(tag, "") for tag in LENS_TAGS))
    return exif.get(ORIENTATION, 1), is_panorama, tuple(str(value)[:LONGEST_TAG] for value in lens), has_alpha


def _write_anew(path: Path, target: Path) -> None:
    try:
        with opened_picture(path) as image:
            upright = ImageOps.exif_transpose(image)
            profile = image.info.get("icc_profile")
    except DECODER_ERRORS as error:
        raise InputError(
            f"{path} cannot be converted: {error}. It may be damaged or cut short; copy it from the camera again."
        ) from error
    # PNG and TIFF ignore the quality.
    upright.save(target, exif=upright.getexif(), icc_profile=profile, quality=JPEG_QUALITY, subsampling=0)


def _too_few(folder: Path, pictures: list[Path], files: list[Path]) -> str:
    if pictures:
        return (
            f"images={folder} holds only {listed(path.name for path in pictures)}. At least {FEWEST} photographs from "
            "different places are needed, better 30 to 100 that overlap."
        )
    inside = sorted(path.name for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    if files:
        endings = listed(sorted({path.suffix for path in files}), cap=6)
        others = f"only other files ({endings})"
        cure = " Convert raw photographs to JPEG first; a film is given with video=FILE."
    else:
        others, cure = "nothing", ""
    folders = f" It has subfolders ({listed(inside, cap=4)}): was one of them meant?" if inside else ""
    return f"images={folder} holds no PNG, JPEG, TIFF, WebP, AVIF or HEIC, {others}.{folders}{cure}"

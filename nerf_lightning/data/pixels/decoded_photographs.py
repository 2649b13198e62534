"""Decode photographs and masks into a pixel store once and map it from then on; hash photographs."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Int, UInt8
from torch import Tensor

from nerf_lightning.data.pixels.downscale import area_downscale, crop_to_multiple, downscaled_size, whole_blocks
from nerf_lightning.data.pixels.mapped_store import CHECKED_WHOLE, FORMAT, Header, check_room, stored
from nerf_lightning.data.pixels.masks import MaskColor, read_mask
from nerf_lightning.data.pixels.picture_files import PictureHeader, image_size, read_header, read_rgba
from nerf_lightning.data.pixels.placement import num_bytes
from nerf_lightning.data.pixels.store import each_or_faults, in_threads
from nerf_lightning.files.folders import default_folder
from nerf_lightning.files.regular import open_regular
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.types.scene import PixelStore

# Megapixels that take a few seconds: beyond, show a progress bar.
NOTICEABLE_PIXELS = 50_000_000
NOTICEABLE_FILES = 1000
TURNED: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    5: lambda stored: stored.T,
    6: lambda stored: np.rot90(stored, -1),
    7: lambda stored: np.rot90(stored, 2).T,
    8: np.rot90,
}
"""Rotations of pixels by their EXIF orientation, for those that swap width and height."""
THINNED = 1 << 28
"""Bytes that are hashed of pixels that may exceed memory (`CHECKED_WHOLE`) and come from the disk."""
LEAST_RESIZED = 0.8
"""Sides of a resized picture are at most this share of the larger ones."""
NOTICEABLE_BYTES = 1 << 31


@dataclass(frozen=True)
class Photograph:
    """A picture file, and optionally a mask of the pixels that count."""

    path: Path
    mask: Path | None = None
    """A gray picture of the same shape, white and black (`masks.read_mask`)."""
    mask_keeps: MaskColor | None = None
    """None: as the user says, else white."""
    radius: float | None = None
    """Radius of the circle around the picture's center that counts, in pixels as stored; None: all pixels count."""
    transparent: int | None = None
    """The level of red, green and blue that means transparent, if the capture says so: 255 (white) or 0."""
    upright: bool = False
    """Whether the pixels are rotated according to an EXIF tag; else they are read as stored."""
    header: PictureHeader | None = None
    """Of the picture, if already read."""
    number: int | None = None
    """Index of the picture in a file with several."""

    def rgba(self) -> UInt8[np.ndarray, "height width 4"]:
        """Return the pixels, with straight alpha."""
        return read_rgba(self.path, self.upright)


def upright_size(photograph: Photograph) -> tuple[int, int]:
    """Return (width, height) in pixels of the photograph as it is read."""
    width, height = (photograph.header or read_header(photograph.path)).size
    return (height, width) if photograph.upright else (width, height)


def read_photographs(
    photographs: Sequence[Photograph], downscale: int, cache_dir: Path | None, verify: bool, label: str
) -> PixelStore:
    """Return the photographs, in order; they may differ in size.

    Decoded pixels are cached as one file, which later calls map into memory at once. It is keyed by the files' names,
    sizes and modification times, and by `downscale`; if one of them changes, another is made. Shrunk photographs lose
    the remainder of `downscale` at the right and the bottom; a shrunk pixel is kept if its mask keeps its whole block.

    Args:
        photographs: the files, at least one.
        downscale: whole factor of the area filter; 1 keeps the pixels unchanged.
        cache_dir: where the decoded pixels are kept; None: in the user's cache folder
            (`$NERF_LIGHTNING_CACHE`, `$XDG_CACHE_HOME` or ~/.cache).
        verify: read all files to check that their contents have not changed since they were decoded.
        label: for the progress bar.

    Raises:
        InputError: a file is missing, cannot be decoded or is refused by `images.read_rgba`; a mask has another size or
            keeps nothing; or the cache folder is full.
    """
    if not photographs:
        raise InputError(f"{label}: there is no photograph to read. Check the capture's folder.")
    folder = default_folder("photographs") if cache_dir is None else cache_dir.expanduser()
    base = folder / _key(photographs, downscale)
    contents = _hash_of_contents(photographs, label) if verify else None
    store = stored(base, contents, partial(_write, list(photographs), downscale, contents, label))
    if len(store.width) != len(photographs):
        raise InputError(
            f"{base}.pixels holds {len(store.width)} photographs instead of {len(photographs)}, so something else "
            f"wrote it. Remove {base}.json, and the photographs will be read again."
        )
    return store


def _key(photographs: Sequence[Photograph], downscale: int) -> str:
    """Return the cache key of the pixels."""
    files = [
        [None if path is None else identity_of(path) for path in (photograph.path, photograph.mask)]
        for photograph in photographs
    ]
    settings = {"format": FORMAT, "downscale": downscale, "files": files}
    if any(upright := [photograph.upright for photograph in photographs]):
        settings["upright"] = upright
    for name in ("mask_keeps", "radius", "transparent", "number"):
        if any(each := [getattr(photograph, name) for photograph in photographs]):
            settings[name] = each
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:24]


def identity_of(path: Path) -> tuple[str, int, int]:
    """Return name, size and modification time, by which a file counts as unchanged."""
    try:
        state = path.stat()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}. Copy it there, or leave it out.") from error
    return str(path.resolve()), state.st_size, state.st_mtime_ns


def _hash_of_contents(photographs: Sequence[Photograph], label: str) -> str:
    """Return one hash of all files."""
    paths = [path for photograph in photographs for path in (photograph.path, photograph.mask) if path is not None]

    def digest(index: int) -> bytes:
        try:
            with open_regular(paths[index], None) as file:  # in chunks
                return hashlib.file_digest(file, "sha256").digest()
        except OSError as error:
            raise InputError(f"{paths[index]} cannot be read: {error.strerror}. Check its permissions.") from error

    digests = in_threads(digest, len(paths), f"{label}: comparing", visible=len(paths) > NOTICEABLE_FILES)
    return hashlib.sha256(b"".join(digests)).hexdigest()


def _write(photographs: list[Photograph], downscale: int, contents: str | None, label: str, target: Path) -> Header:
    """Decode everything into the file `target`.

    The threads write to the file and not through a mapping, so no picture stays in this process's memory.
    """
    sizes = _sizes(photographs, downscale, label)
    masked = any(photograph.mask is not None or photograph.radius is not None for photograph in photographs)
    ends = np.cumsum([width * height for width, height in sizes])
    num_pixels = int(ends[-1])
    check_room(target.parent, num_pixels * (5 if masked else 4))
    target.touch(mode=0o600)

    def decode(index: int) -> bool:
        photograph, size = photographs[index], sizes[index]
        rgba = photograph.rgba()
        if photograph.transparent is not None:
            rgba[(rgba[..., :3] == photograph.transparent).all(axis=-1)] = 0
        rgba = area_downscale(crop_to_multiple(rgba, downscale), downscale)
        _check_unchanged(rgba, size, photograph.path)
        start = int(ends[index]) - rgba.shape[0] * rgba.shape[1]
        with target.open("r+b") as file:
            file.seek(4 * start)
            file.write(np.ascontiguousarray(rgba).data)
            if masked:
                file.seek(4 * num_pixels + start)
                file.write(np.ascontiguousarray(_mask(photograph, size, downscale)).data)
        return bool((rgba[..., 3] < 255).any())

    transparent = each_or_faults(decode, len(photographs), label, visible=num_pixels * downscale**2 > NOTICEABLE_PIXELS)
    return Header(FORMAT, [list(size) for size in sizes], any(transparent), masked, contents, spots=0, checksum=0)


def _sizes(photographs: list[Photograph], downscale: int, label: str) -> list[tuple[int, int]]:
    """Return the shrunk (width, height) of each from the headers, and compare masks with them."""

    def size(index: int) -> tuple[int, int]:
        path, mask = photographs[index].path, photographs[index].mask
        width, height = upright_size(photographs[index])
        sizes = ((width, height), (height, width)) if photographs[index].upright else ((width, height),)
        if mask is not None and not any(of_one_shape(image_size(mask), size) for size in sizes):
            across, down = image_size(mask)
            raise InputError(
                f"The mask {mask} has {across} x {down} pixels, but its photograph {path} has {width} x {height}, "
                "which is another shape. Make the mask for this photograph, as large as it is or resized."
            )
        return downscaled_size(width, height, downscale)

    return each_or_faults(size, len(photographs), f"{label}: sizes", visible=len(photographs) > NOTICEABLE_FILES)


def of_one_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Return whether two sizes are equal, or one is the other resized; nearly equal sizes are crops."""
    (width, height), (across, down) = size, other
    rounding = 0.5 * max(width + height, across + down)
    resized = not LEAST_RESIZED < width / across < 1 / LEAST_RESIZED
    return size == other or (resized and abs(width * down - height * across) <= min(rounding, 0.1 * height * across))


def _mask(
    photograph: Photograph, size: tuple[int, int], downscale: int
) -> Bool[np.ndarray, "small_height small_width"]:
    width, height = upright_size(photograph)
    kept = np.ones((height, width), dtype=np.bool_)
    if photograph.mask is not None:
        kept = _mask_of(photograph, photograph.mask, (width, height))
        if not of_one_shape((kept.shape[1], kept.shape[0]), (width, height)):
            _check_unchanged(kept, (width, height), photograph.mask)
        kept = _resized(kept, (width, height))
    if photograph.radius is not None:
        y, x = (np.arange(side) + 0.5 - side / 2 for side in kept.shape)
        kept = kept & (np.hypot(x, y[:, None]) <= photograph.radius)
    kept = whole_blocks(kept, downscale)
    _check_unchanged(kept, size, photograph.mask or photograph.path)
    if not kept.any():
        shrunk = f" (shrunk by {downscale}, a pixel needs its whole block)" if downscale > 1 else ""
        raise InputError(
            f"The mask {photograph.mask or 'fisheye_crop_radius'} leaves no pixel of {photograph.path}{shrunk}: it "
            f"keeps what is {photograph.mask_keeps or 'white'}. Fix the mask, or remove this view."
        )
    return kept


def _mask_of(photograph: Photograph, mask: Path, size: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
    """Return a photograph's mask at its own size, rotated like the photograph (`size`)."""
    header = read_header(mask)
    as_shown = photograph.upright and not of_one_shape(header.size, size)
    kept = read_mask(mask, photograph.mask_keeps or "white", as_shown)
    if as_shown and header.orientation == 1:  # programs that write masks may drop the tag
        kept = TURNED[read_header(photograph.path).orientation](kept)
    return kept


def _resized(mask: Bool[np.ndarray, "h w"], size: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
    """Return a mask resized to (width, height) by nearest neighbor."""
    if mask.shape == size[::-1]:
        return mask
    row, column = (((np.arange(n) + 0.5) * m / n).astype(np.int64) for n, m in zip(size[::-1], mask.shape, strict=True))
    return np.asarray(mask[row[:, None], column])


def _check_unchanged(pixels: np.ndarray, size: tuple[int, int], path: Path) -> None:
    """Refuse a file that has changed since its header was read: it would overwrite its neighbor."""
    if (pixels.shape[1], pixels.shape[0]) != size:
        raise InputError(f"{path} changed while it was read. Try again when it is complete.")


def photograph_hashes(pixels: PixelStore) -> Int[Tensor, "views"]:
    """Return a hash (BLAKE2b, 64 bits) of each view's pixels and mask, as they are trained on.

    Beyond 4 GiB only every k-th row counts, 256 MiB in total: a photograph whose exposure, sharpness or crop changed is
    detected, and one that was retouched in a few rows may not be.
    """
    total = num_bytes(pixels)
    step = 1 if total <= CHECKED_WHOLE else -(-total // THINNED)

    def digest(view: int) -> int:
        kept = pixels.view_mask(view)
        found = hashlib.blake2b(pixels.view(view)[::step].contiguous().numpy().data, digest_size=8)
        if kept is not None:
            found.update(kept[::step].contiguous().numpy().data)
        return int.from_bytes(found.digest(), "little", signed=True)

    shown = total > NOTICEABLE_BYTES
    return torch.tensor(in_threads(digest, len(pixels.offset), "Comparing photographs", shown), dtype=torch.int64)

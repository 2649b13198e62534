"""Pixel stores as memory-mapped files: they may be larger than memory, and processes share one copy.

KEY.pixels contains the RGBA of every view, followed, if there are masks, by a byte per pixel. KEY.json is written last
and describes the other file: without it, or if the two disagree, the store is not used.
"""

import json
import logging
import mmap
import platform
import shutil
import sys
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock
from jaxtyping import UInt8
from torch import Tensor

from nerf_lightning.data.pixels.store import layout
from nerf_lightning.files.atomic import persistently, whole_file
from nerf_lightning.files.json_files import parse_json
from nerf_lightning.files.made_folders import make_own_folder
from nerf_lightning.files.regular import AbsentError, open_own
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.types.scene import PixelStore

FORMAT = 3
SPOTS, SPOT_BYTES = 64, 4096
CHECKED_WHOLE = 1 << 32
"""Maximum size in bytes of files that are compared with their checksum at each start (0.4 s per gigabyte in memory); of
larger ones, which may exceed memory, only spots are checked, unless contents are to be compared."""
PIECE = 1 << 24
LONGEST_SIDE = 1 << 24
GIGABYTE = 1e9

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Header:
    """Description of a file of pixels."""

    format: int
    sizes: list[list[int]]
    """Width and height of each view."""
    has_transparency: bool
    masked: bool
    contents: str | None
    """Hash of the source pictures, if they were hashed."""
    spots: int
    """Checksum of a few evenly spread spots: detects what a machine crash left unwritten."""
    checksum: int
    """Of all bytes (CRC-32): detects what a failing disk has changed."""

    @property
    def num_pixels(self) -> int:
        """Total number of pixels in all views."""
        return sum(width * height for width, height in self.sizes)

    @property
    def num_bytes(self) -> int:
        """Size of the file."""
        return self.num_pixels * (5 if self.masked else 4)


@dataclass(frozen=True)
class MappedPixelStore(PixelStore):
    """A store whose arrays map a file. It is pickled as a path: another process maps the same file."""

    path: Path = field(kw_only=True)
    header: Header = field(kw_only=True)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the path, not the pixels, which may exceed memory."""
        return _mapped, (self.path, self.header)


def stored(base: Path, contents: str | None, make: Callable[[Path], Header]) -> PixelStore:
    """Return the store at `base`, creating it if necessary.

    If several processes call this at once, one makes the store and the others wait. A damaged store is made again.

    Args:
        base: path of the files without their extensions.
        contents: hash of the pictures; a store made from others, or never hashed, is made again. None: not compared.
        make: writes the pixels to the given path and describes them; the checksums are filled in here.

    Raises:
        InputError: the folder is not writable, or others can write to it, too.
    """
    try:
        make_own_folder(base.parent)
        header = _sound_header(base, contents)
        if header is None:
            with FileLock(base.with_suffix(".lock")):
                # Another process may have made it in the meantime.
                header = _sound_header(base, contents) or _make(base, make)
    except OSError as error:
        raise InputError(
            f"The pixels of the photographs cannot be cached in {base.parent}: {error.strerror or error}. Make room or "
            "name another folder with NERF_LIGHTNING_CACHE or scene.cache_dir."
        ) from error
    return _mapped(base.with_suffix(".pixels"), header)


def check_room(folder: Path, num_bytes: int) -> None:
    """Refuse to write more than fits on the disk."""
    free = shutil.disk_usage(folder).free
    if free < num_bytes:
        raise InputError(
            f"The pixels of the photographs need {num_bytes / GIGABYTE:.2f} GB in {folder}, where "
            f"{free / GIGABYTE:.2f} GB are free. Make room, name a folder on another disk with NERF_LIGHTNING_CACHE "
            "or scene.cache_dir, or shrink the pictures with scene.downscale."
        )


def _make(base: Path, make: Callable[[Path], Header]) -> Header:
    """Write the pixels, and the header once the file has its final name."""
    path, about = base.with_suffix(".pixels"), base.with_suffix(".json")
    with whole_file(about, mode=0o600) as note, whole_file(path, mode=0o600) as part:
        header = make(part)
        header = Header(**(asdict(header) | {"spots": _spots(part), "checksum": _checksum(part)}))
        note.write_text(json.dumps(asdict(header)), encoding="utf-8")
        persistently(lambda: about.unlink(missing_ok=True))
    log.info("Cached %d pictures in %s.pixels (%.2f GB).", len(header.sizes), base, header.num_bytes / GIGABYTE)
    return header


def _sound_header(base: Path, contents: str | None) -> Header | None:
    """Return the header of a complete, up-to-date store, else None."""
    path = base.with_suffix(".pixels")
    try:
        with open_own(base.with_suffix(".json"), "json") as file:
            header = Header(**parse_json(file.read().decode(), base))
        _require_numbers(header)
        sound = header.format == FORMAT and header.num_bytes == path.stat().st_size and header.spots == _spots(path)
        if sound and (contents is not None or header.num_bytes <= CHECKED_WHOLE):
            sound = header.checksum == _checksum(path)
    except AbsentError:
        return None
    except (OSError, ValueError, TypeError, KeyError, RecursionError, InputError) as error:
        log.warning("%s is not used (%s); the photographs are read again.", base, error)
        return None
    if not sound:
        log.warning("%s is damaged; the photographs are read again.", path)
        return None
    if contents is not None and contents != header.contents:
        log.info("%s was made from other files, or without comparing them; it is made again.", path)
        return None
    return header


def _require_numbers(header: Header) -> None:
    """Refuse invalid sizes: offsets into the file follow from them."""
    sizes_fit = all(
        len(size) == 2 and all(type(side) is int and 0 < side < LONGEST_SIDE for side in size) for size in header.sizes
    )
    if not sizes_fit or type(header.masked) is not bool or type(header.has_transparency) is not bool:
        raise ValueError("invalid sizes or switches")


def _spots(path: Path) -> int:
    """Return the checksum of evenly spread spots of a file, including its first and last bytes."""
    checksum = 0
    last = max(0, path.stat().st_size - SPOT_BYTES)
    with open_own(path, None) as file:
        for number in range(SPOTS):
            file.seek(last * number // (SPOTS - 1))
            checksum = zlib.crc32(file.read(SPOT_BYTES), checksum)
    return checksum


def _checksum(path: Path) -> int:
    """Return the checksum of a whole file."""
    checksum = 0
    with open_own(path, None) as file:
        while piece := file.read(PIECE):
            checksum = zlib.crc32(piece, checksum)
    return checksum


def _mapped(path: Path, header: Header) -> MappedPixelStore:
    """Return the store as views of the file; writes to them stay in this process."""
    bytes_ = _mapped_bytes(path)
    rgba = bytes_[: 4 * header.num_pixels].view(-1, 4)
    sizes = [(width, height) for width, height in header.sizes]
    mask = bytes_[4 * header.num_pixels :] if header.masked else None
    offset, width, height = layout(sizes)
    return MappedPixelStore(
        rgba=rgba,
        offset=offset,
        width=width,
        height=height,
        has_transparency=header.has_transparency,
        mask=mask,
        path=path,
        header=header,
    )


def _mapped_bytes(path: Path) -> UInt8[Tensor, "bytes"]:
    with open_own(path, None) as file:
        if sys.platform == "linux":
            # All of a private mapping counts as memory that might be written, so a file larger than the machine's
            # memory would be refused. Nothing writes to it, so no memory is reserved. Python has the flag's number
            # since 3.13.
            generic = 0x4000 if platform.machine() in ("x86_64", "aarch64") else 0
            flags = mmap.MAP_PRIVATE | getattr(mmap, "MAP_NORESERVE", generic)
            mapping = mmap.mmap(file.fileno(), 0, flags=flags, prot=mmap.PROT_READ | mmap.PROT_WRITE)
        else:
            mapping = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
    if hasattr(mmap, "MADV_RANDOM"):
        # Batches read single pixels from all over the file: reading ahead would only evict others.
        mapping.madvise(mmap.MADV_RANDOM)
    return torch.frombuffer(mapping, dtype=torch.uint8)

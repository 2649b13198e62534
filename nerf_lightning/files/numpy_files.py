"""Arrays in files of numpy's: never unpickled, and nothing is unpacked before its size is known and allowed."""

import io
import math
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped
from numpy import ndarray

from nerf_lightning.messages.errors import InputError

HEADER_BYTES = 1 << 14  # numpy itself reads no header longer than 10,000 characters


@dataclass(frozen=True)
class ArrayHeader:
    """What a file says of an array before its numbers come."""

    shape: tuple[int, ...]
    dtype: np.dtype
    num_bytes: int
    """Of the numbers."""


def array_header(start: bytes, size: int) -> ArrayHeader:
    """Return what the first `HEADER_BYTES` of a .npy file say, or all of it; `size` is that of the whole file.

    Raises:
        ValueError: no such file, one with Python objects, or a file of another size than its array.
        Exception: whatever numpy raises for a header that it cannot parse.
    """
    stream = io.BytesIO(start)
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(stream)  # a Python literal; what no parser takes is said in many ways
    if dtype.hasobject:
        raise ValueError("Object arrays cannot be loaded: they are programs in disguise")
    num_bytes = math.prod(shape) * dtype.itemsize
    if num_bytes != size - stream.tell():
        raise ValueError(f"its header announces {num_bytes:,} bytes of numbers, and {size - stream.tell():,} are there")
    return ArrayHeader(shape, dtype, num_bytes)


def archive_headers(archive: zipfile.ZipFile, keys: Sequence[str]) -> dict[str, ArrayHeader]:
    """Return the headers of the arrays in an .npz archive that bear these names; absent ones are left out."""
    entries = {entry.filename: entry for entry in archive.infolist()}
    headers = {}
    for key in keys:
        entry = entries.get(f"{key}.npy")
        if entry is not None:
            with archive.open(entry) as file:
                headers[key] = array_header(file.read(HEADER_BYTES), entry.file_size)
    return headers


def read_member(archive: zipfile.ZipFile, key: str) -> Shaped[ndarray, "..."]:
    """Return an array of an archive, whose header was looked at before.

    Raises:
        ValueError: it holds Python objects, or is damaged.
    """
    # zipfile hands out no more than the size that it announces.
    with archive.open(f"{key}.npy") as file:
        array: Any = np.lib.format.read_array(file, allow_pickle=False)
        return np.asarray(array)


def check_unpacked(path: Path, num_bytes: int, most: float, cure: str) -> None:
    """Refuse what would unpack to more than is allowed."""
    if num_bytes > most:
        raise InputError(
            f"{path} ({path.stat().st_size:,} bytes) unpacks to {num_bytes / 1e9:,.2f} GB, and {most / 1e9:g} GB are "
            f"allowed. {cure}"
        )

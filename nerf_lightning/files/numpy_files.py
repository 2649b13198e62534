"""Files of numpy's: never unpickled, and no larger in memory than on the disk, or than the budgets allow."""

import io
import math
import os
import zipfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO

import numpy as np
from jaxtyping import Float, Shaped
from numpy import ndarray

from nerf_lightning.files.budgets import limits, require_within
from nerf_lightning.files.regular import HeaderReader, open_regular
from nerf_lightning.files.trust import reading

ENTRY_BYTES = 100
"""Of an archive's list of its arrays, for each of them."""


def read_npy(path: Path, cure: str) -> Shaped[ndarray, "..."]:
    """Return the array of an .npy file."""
    with reading(path, cure), open_regular(path, "npy", cure) as file:
        return _array(file, os.fstat(file.fileno()).st_size)


@contextmanager
def open_npz(path: Path, cure: str) -> Iterator[dict[str, Callable[[], ndarray]]]:
    """Open an .npz file: by the name of each array, what reads it."""
    with reading(path, cure), open_regular(path, "npz", cure) as opened:
        file = HeaderReader(opened, ENTRY_BYTES * limits().npz_arrays, "npz_arrays", path, "arrays")
        with zipfile.ZipFile(file) as archive:  # hands out no more of an entry than the size that it announces
            require_within("npz_arrays", len(archive.infolist()), path, "arrays")
            size = sum(entry.file_size for entry in archive.infolist())
            require_within("npz_bytes", size, path, "bytes once it is unpacked")
            file.left = None
            yield {each.filename.removesuffix(".npy"): partial(_entry, archive, each) for each in archive.infolist()}


def _entry(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> Shaped[ndarray, "..."]:
    with archive.open(entry) as file:
        return _array(file, entry.file_size)


def _array(file: IO[bytes] | io.BufferedIOBase, size: int) -> Shaped[ndarray, "..."]:
    """Return the array of a file of so many bytes; numpy itself takes the memory that a header claims."""
    version = np.lib.format.read_magic(file)
    of_version = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, kind = of_version(file)
    if math.prod(shape) * kind.itemsize > size:
        raise ValueError(f"it claims the shape {shape}, and has {size:,} bytes")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)


def read_columns(lines: Iterable[str], columns: list[int], count: int) -> Float[ndarray, "rows columns"]:
    """Return columns of the first rows of a text of numbers, at least one."""
    return np.loadtxt(lines, usecols=columns, max_rows=count, ndmin=2, comments=None)

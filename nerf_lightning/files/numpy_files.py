"""Files of numpy's: never unpickled, and no larger in memory than the budgets allow."""

import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped
from numpy import ndarray

from nerf_lightning.files.budgets import limits, require_within
from nerf_lightning.files.regular import HeaderReader, open_regular
from nerf_lightning.files.trust import reading

ENTRY_BYTES = 100
"""Of an archive's list of its arrays, for each of them."""


def read_npy(path: Path, cure: str) -> Shaped[ndarray, "..."]:
    """Return the array of an .npy file: by its own format, since np.load opens archives, too."""
    with reading(path, cure), open_regular(path, "npy", cure) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


@contextmanager
def open_npz(path: Path, cure: str) -> Iterator[Any]:
    """Open an .npz file as numpy does: arrays by name, each of which is read when it is asked for."""
    with reading(path, cure), open_regular(path, "npz", cure) as opened:
        file = HeaderReader(opened, ENTRY_BYTES * limits().npz_arrays, "npz_arrays", path, "arrays")
        with zipfile.ZipFile(file) as archive:  # hands out no more of an entry than the size that it announces
            entries = archive.infolist()
        require_within("npz_arrays", len(entries), path, "arrays")
        require_within("npz_bytes", sum(entry.file_size for entry in entries), path, "bytes once it is unpacked")
        file.left = None
        file.seek(0)
        with np.load(file, allow_pickle=False) as arrays:
            yield arrays


def read_columns(lines: Iterable[str], columns: list[int], count: int) -> Float[ndarray, "rows columns"]:
    """Return columns of the first rows of a text of numbers."""
    if not count:
        return np.zeros((0, len(columns)))
    return np.loadtxt(lines, usecols=columns, max_rows=count, ndmin=2, comments=None)

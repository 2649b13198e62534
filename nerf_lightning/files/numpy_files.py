"""Files of numpy's: never unpickled, and opened only if all that they hold may be unpacked."""

import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Shaped
from numpy import ndarray

from nerf_lightning.files.archives import start_of_directory
from nerf_lightning.files.budgets import limits, require_within
from nerf_lightning.files.regular import open_regular
from nerf_lightning.files.trust import reading

ENTRY_BYTES = 100
"""Of an archive's list of its arrays, for each of them."""


def read_npy(path: Path, cure: str) -> Shaped[ndarray, "..."]:
    """Return the array of an .npy file."""
    with reading(path, cure), open_regular(path, "npy", cure) as file:
        # Read by its own format: np.load would open archives too, and unpickle what is neither.
        return np.lib.format.read_array(file, allow_pickle=False)


@contextmanager
def open_npz(path: Path, cure: str) -> Iterator[Mapping[str, ndarray]]:
    """Open an .npz file: its arrays by name, each of which is read when it is asked for."""
    with reading(path, cure), open_regular(path, "npz", cure) as file:
        start_of_directory(file, ENTRY_BYTES * limits().npz_arrays)
        with zipfile.ZipFile(file) as archive:  # hands out no more of an entry than the size that it announces
            sizes = [entry.file_size for entry in archive.infolist()]
        require_within("npz_arrays", len(sizes), path, "arrays")
        require_within("npz_bytes", sum(sizes), path, "bytes once it is unpacked")
        file.seek(0)
        with np.load(file, allow_pickle=False) as arrays:
            yield arrays

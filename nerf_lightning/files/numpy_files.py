"""NumPy files: never unpickled, and opened only if their unpacked size is allowed."""

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
"""Bytes per array in an archive's directory."""


def read_npy(path: Path, cure: str) -> Shaped[ndarray, "..."]:
    """Return the array of an .npy file."""
    with reading(path, cure), open_regular(path, "npy", cure) as file:
        # Read by its own format: np.load would also open archives, and unpickle anything else.
        return np.lib.format.read_array(file, allow_pickle=False)


@contextmanager
def open_npz(path: Path, cure: str) -> Iterator[Mapping[str, ndarray]]:
    """Open an .npz file: its arrays by name, each read on access."""
    with reading(path, cure), open_regular(path, "npz", cure) as file:
        start_of_directory(file, ENTRY_BYTES * limits().npz_arrays)
        with zipfile.ZipFile(file) as archive:  # yields no more of an entry than its announced size
            sizes = [entry.file_size for entry in archive.infolist()]
        require_within("npz_arrays", len(sizes), path, "arrays")
        require_within("npz_bytes", sum(sizes), path, "bytes once it is unpacked")
        file.seek(0)
        with np.load(file, allow_pickle=False) as arrays:
            yield arrays

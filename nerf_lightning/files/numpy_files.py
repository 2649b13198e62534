"""Archives of numpy's: never unpickled, and opened only if all that they hold may be unpacked."""

import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from nerf_lightning.messages.errors import InputError


def open_archive(file: BinaryIO, path: Path, most_bytes: int | float, cure: str) -> Any:
    """Return an open .npz file as numpy does: arrays by name, each of which is read when it is asked for.

    Raises:
        InputError: it would unpack to more than is allowed.
        zipfile.BadZipFile: it is no archive.
    """
    with zipfile.ZipFile(file) as archive:  # hands out no more of an entry than the size that it announces
        num_bytes = sum(entry.file_size for entry in archive.infolist())
    if num_bytes > most_bytes:
        raise InputError(
            f"{path} ({path.stat().st_size:,} bytes) unpacks to {num_bytes / 1e9:,.2f} GB, and {most_bytes / 1e9:g} GB "
            f"are allowed. {cure}"
        )
    file.seek(0)
    return np.load(file, allow_pickle=False)

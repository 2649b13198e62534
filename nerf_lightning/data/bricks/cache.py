"""Cache rendered pictures: one uncompressed .npz per setting, written atomically."""

import hashlib
import json
import logging
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from filelock import FileLock
from jaxtyping import UInt8
from numpy import ndarray

from nerf_lightning.files.atomic import whole_file
from nerf_lightning.files.made_folders import make_own_folder
from nerf_lightning.files.regular import open_own
from nerf_lightning.messages.errors import InputError

Pictures = UInt8[ndarray, "pixels 4"]
"""The pixels of all views of a generated scene, concatenated."""

logger = logging.getLogger(__name__)


def cache_file(folder: Path, settings: dict[str, int]) -> Path:
    """Return the cache file for settings, which include the version of the renderer."""
    key = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]
    return folder / f"{key}.npz"


def cached(path: Path, pixels: int, make: Callable[[], Pictures]) -> Pictures:
    """Return the content of `path` if it is a valid file of `pixels` pixels; otherwise make and store it.

    If several processes call this at once, one makes it and the others wait. A damaged file is made again. If the
    folder is not writable, warn, and make it in every run.
    """
    try:
        make_own_folder(path.parent)
        lock = FileLock(path.with_suffix(".lock"))
        lock.acquire()
    except (OSError, InputError) as error:
        logger.warning("Cannot keep the bricks scene in %s (%s); it is rendered again.", path.parent, error)
        return make()
    try:
        kept = _load(path, pixels)
        return _save(path, make()) if kept is None else kept
    finally:
        lock.release()


def _load(path: Path, pixels: int) -> Pictures | None:
    """Return the content of a valid file, or None."""
    if not path.exists():
        return None
    try:
        with open_own(path, None) as file, np.load(file, allow_pickle=False) as archive:
            rgba = np.asarray(archive["rgba"])
        if (rgba.shape, rgba.dtype) != ((pixels, 4), "uint8"):
            raise ValueError(f"rgba is {rgba.shape} of {rgba.dtype}")
        return rgba
    except (OSError, ValueError, KeyError, EOFError, RuntimeError, zlib.error, zipfile.BadZipFile, InputError) as error:
        logger.warning("The cached bricks scene %s is damaged (%s): it is rendered again.", path, error)
        return None


def _save(path: Path, rgba: Pictures) -> Pictures:
    try:
        with whole_file(path, mode=0o600) as part:
            np.savez(part, rgba=rgba)
    except OSError as error:
        logger.warning("Cannot keep the bricks scene in %s (%s).", path.parent, error)
    return rgba

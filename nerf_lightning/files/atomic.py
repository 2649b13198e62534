"""Files that are either whole or not there."""

import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from nerf_lightning.files.made_folders import make_folder

try:
    import fcntl
except ImportError:  # Windows: what killed processes leave there stays
    fcntl = None  # type: ignore[assignment]

FULL = (errno.ENOSPC, errno.EDQUOT)
NO_ROOM = (*FULL, errno.EFBIG)  # A file may also be larger than is allowed
_PART = re.compile(r"\..*\.\d+\.part(\.\w+)?")


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Lend a temporary path beside `path` that takes its place when the block ends well, else is removed.

    A missing folder is made; below one that the user named, `make_folder` does it first, and refuses links. The
    temporary name keeps the suffix, since writers choose a format by it. What killed processes left in the folder is
    removed.
    """
    make_folder(path.parent)
    _sweep(path.parent)
    part = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        part.unlink(missing_ok=True)  # a link of this name, planted or left, would be written through
        with full_disk_named(path), _held(part):
            yield part
            os.replace(part, path)
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)  # what is wrong with a disk is not said of any file
        raise
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def full_disk_named(place: Path) -> Iterator[None]:
    """Say of a full disk, a spent quota, or a file that may not grow, where it is: `place`, if nothing nearer is known.

    The system says it of no file; a copy says it of the file that it reads.
    """
    try:
        yield
    except OSError as error:
        if error.errno in NO_ROOM:
            error.filename, error.filename2 = str(error.filename2 or error.filename or place), None
        raise


@contextmanager
def _held(part: Path) -> Iterator[None]:
    """Make the file, and hold it locked: its writer is alive."""
    if fcntl is None:
        yield
        return
    handle = _locked(part)
    try:
        yield
    finally:
        os.close(handle)


def _locked(part: Path) -> int:
    """Make a file and lock it; where another process takes it for a dead one's in between, and removes it, again."""
    while True:
        handle = os.open(part, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        with suppress(OSError):  # a file system without locks
            fcntl.flock(handle, fcntl.LOCK_EX)  # whoever sweeps holds it for a moment
        if _is_at(handle, part):
            return handle
        os.close(handle)


def _is_at(handle: int, path: Path) -> bool:
    """Tell whether an open file is still the one of this name."""
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path, follow_symlinks=False))
    except FileNotFoundError:
        return False


@cache
def _sweep(folder: Path) -> None:
    """Remove the temporary files that nobody holds, once in a process's life."""
    if fcntl is None:
        return
    for part in folder.iterdir():
        if _PART.fullmatch(part.name) and part.is_file():
            with suppress(OSError):  # held by another process, gone meanwhile, or another user's
                handle = os.open(part, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK)
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    if _is_at(handle, part):
                        part.unlink()
                finally:
                    os.close(handle)

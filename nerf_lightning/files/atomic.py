"""Files that are either complete or absent."""

import errno
import os
import platform
import re
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import psutil

from nerf_lightning.files.made_folders import make_folder

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

FULL = (errno.ENOSPC, errno.EDQUOT)
NO_ROOM = (*FULL, errno.EFBIG)  # A file may also be larger than allowed
MACHINE = f"{zlib.crc32(platform.node().encode()):08x}"  # Folders are shared between machines
PATIENCE_SECONDS, PAUSE_SECONDS = 1.0, 0.05
PART = re.compile(r"\..*\.(\d{1,9})_([0-9a-f]{8})\.nerf_lightning\.part(\.[^.]+)?", re.DOTALL)


@contextmanager
def whole_file(path: Path, mode: int = 0o666) -> Iterator[Path]:
    """Yield a temporary path next to `path` that replaces it if the block succeeds, and is removed otherwise.

    A missing folder is made; below one that the user named, `make_folder` makes it first, and refuses links. The
    temporary name keeps the suffix, since writers choose a format by it. Leftovers of killed processes in the folder
    are removed.
    """
    make_folder(path.parent)
    remove_leftovers(path.parent)
    part = path.with_name(f".{path.stem}.{os.getpid()}_{MACHINE}.nerf_lightning.part{path.suffix}")
    try:
        part.unlink(missing_ok=True)  # writing would follow a link of this name, planted or left over
        with full_disk_named(path), _held(part, mode):
            yield part
            persistently(os.replace, part, path)
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)  # disk errors name no file
        raise
    finally:
        part.unlink(missing_ok=True)


def persistently(change: Callable[..., None], *arguments: Any) -> None:
    """Rename or remove a file; if that is not permitted, retry for a second.

    Windows does not permit it while another process has the file open: one of our readers, a virus scanner, a backup.
    """
    end = time.monotonic() + PATIENCE_SECONDS
    while True:
        try:
            return change(*arguments)
        except PermissionError:
            if time.monotonic() > end:
                raise
            time.sleep(PAUSE_SECONDS)


@contextmanager
def full_disk_named(path: Path) -> Iterator[None]:
    """Name the location of a full disk, an exhausted quota or a file-size limit: `path`, if nothing closer is known.

    The system names no file; a copy names the file that it reads.
    """
    try:
        yield
    except OSError as error:
        if error.errno in NO_ROOM:
            error.filename, error.filename2 = str(error.filename2 or error.filename or path), None
        raise


@contextmanager
def _held(part: Path, mode: int) -> Iterator[None]:
    """Make the file, and keep it locked while its writer is alive."""
    if fcntl is None:
        yield
        return
    while True:
        handle = os.open(part, os.O_RDWR | os.O_CREAT | os.O_EXCL, mode)
        with suppress(OSError):  # a file system without locks
            fcntl.flock(handle, fcntl.LOCK_EX)
        if _is_at(handle, part):
            break
        os.close(handle)  # another process considered its writer dead and removed it
    try:
        yield
    finally:
        os.close(handle)


def _is_at(handle: int, path: Path) -> bool:
    """Return whether an open file is still the one at this path."""
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path, follow_symlinks=False))
    except FileNotFoundError:
        return False


@cache
def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files whose writers are dead, once per process."""
    for part in folder.iterdir():
        if (name := PART.fullmatch(part.name)) and part.is_file():
            with suppress(OSError):  # held by another process, already gone, or another user's
                _remove_dead(part, has_ended=name[2] == MACHINE and not psutil.pid_exists(int(name[1])))


def _remove_dead(part: Path, has_ended: bool) -> None:
    """Remove a temporary file unless its writer holds the lock; without locks, if its process has ended."""
    if fcntl is None:
        if has_ended:
            part.unlink()
        return
    with os.fdopen(os.open(part, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK), "r+b") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if isinstance(error, BlockingIOError) or not has_ended:
                raise
        if _is_at(file.fileno(), part):
            part.unlink()

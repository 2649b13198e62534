"""Files of folders that anybody may have made: opened only where they are regular files, and of a bounded size.

An archive can carry a FIFO, which is waited for without end, and a link can lead to a device. So a file is opened
without waiting, and asked what it is once it is open: nobody can put another one in its place in between.
"""

import codecs
import errno
import io
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from nerf_lightning.messages.errors import InputError

# Of posix; Windows has neither FIFOs nor devices among its files.
WITHOUT_WAITING = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)
NO_LINK = getattr(os, "O_NOFOLLOW", 0)
BINARY = getattr(os, "O_BINARY", 0)
KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a named pipe (FIFO)"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)
CURE = "It is damaged, or was made by somebody else: replace it with an intact copy, or remove it."


def open_regular(path: Path, most_bytes: int | None, cure: str = CURE, follow_links: bool = True) -> io.BufferedReader:
    """Open a regular file for reading.

    Args:
        path: where it lies.
        most_bytes: its largest size; None where the reader itself takes no more than it has checked.
        cure: what to do about what is no such file, for the message.
        follow_links: open what a symbolic link leads to; where it may lead is for the caller to say.

    Raises:
        InputError: it is no regular file, is larger, or is a link that is not followed.
        OSError: it cannot be opened.
    """
    return os.fdopen(_opened(path, os.O_RDONLY, most_bytes, cure, follow_links), "rb")


def open_to_append(path: Path, cure: str = CURE) -> io.BufferedWriter:
    """Open a regular file for writing at its end; it is made where there is none. Links are not followed.

    Raises:
        InputError: it is no regular file.
        OSError: it cannot be opened.
    """
    return os.fdopen(_opened(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, None, cure, follow_links=False), "ab")


def read_bytes(path: Path, most_bytes: int, cure: str = CURE) -> bytes:
    """Return the content of a regular file."""
    with explained(path, cure), open_regular(path, most_bytes, cure) as file:
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:  # it has grown
        raise InputError(_too_large(path, len(content), most_bytes, cure))
    return content


def read_text(path: Path, most_bytes: int, cure: str = CURE) -> str:
    """Return the content of a text file in UTF-8, or in UTF-16 with a byte order mark; ends of lines become \\n."""
    content = io.BytesIO(read_bytes(path, most_bytes, cure))
    try:
        return io.TextIOWrapper(content, encoding_of(content)).read()
    except UnicodeError as error:
        where = f" (byte {error.start} is not UTF-8)" if isinstance(error, UnicodeDecodeError) else ""
        raise InputError(f"{path} is not a text file{where}. {cure}") from error


def encoding_of(file: io.BufferedIOBase) -> str:
    """Return how the text of a file is encoded, by its byte order mark: UTF-16, which Windows writes, or UTF-8."""
    start = file.read(2)
    file.seek(0)
    return "utf-16" if start in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else "utf-8-sig"


@contextmanager
def explained(path: Path, cure: str = CURE) -> Iterator[None]:
    """Say of a file that cannot be opened or read what to do about it."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}. {cure}") from error
    except ValueError as error:  # NUL
        raise InputError(f"{path} cannot be read: {error}. {cure}") from error


def _opened(path: Path, flags: int, most_bytes: int | None, cure: str, follow_links: bool) -> int:
    link = 0 if follow_links else NO_LINK
    try:
        handle = os.open(path, flags | WITHOUT_WAITING | BINARY | link, 0o666)
    except OSError as error:
        # A socket, or a pipe that nobody reads, cannot be opened; a link has an error of its own.
        kind = "a symbolic link" if link and error.errno in (errno.ELOOP, errno.EMLINK) else _kind_by_name(path)
        if kind is None:
            raise
        raise InputError(_of_another_kind(path, kind, cure)) from error
    try:
        state = os.fstat(handle)
        if not stat.S_ISREG(state.st_mode):
            raise InputError(_of_another_kind(path, _kind(state.st_mode) or "no regular file", cure))
        if most_bytes is not None and state.st_size > most_bytes:
            raise InputError(_too_large(path, state.st_size, most_bytes, cure))
    except BaseException:
        os.close(handle)
        raise
    return handle


def _kind_by_name(path: Path) -> str | None:
    try:
        return _kind(os.stat(path).st_mode)
    except OSError:
        return None


def _kind(mode: int) -> str | None:
    return next((name for is_kind, name in KINDS if is_kind(mode)), None)


def _of_another_kind(path: Path, kind: str, cure: str) -> str:
    return f"{path} is {kind}, and only regular files are opened here. {cure}"


def _too_large(path: Path, size: int, most_bytes: int, cure: str) -> str:
    return f"{path} has {size:,} bytes, more than the limit of {most_bytes:,}. {cure}"

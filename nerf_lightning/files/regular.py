"""Files of folders that anybody may have made: opened only where they are regular files, and of a bounded size.

An archive can carry a FIFO, which is waited for without end, and a link can lead to a device. So a file is opened
without waiting, and asked what it is once it is open: nobody can put another one in its place in between.
"""

import codecs
import errno
import io
import math
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from nerf_lightning.files.budgets import limits, require_text_within, require_within
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


def open_regular(path: Path, size: str | int | None, cure: str = CURE, follow_links: bool = True) -> io.BufferedReader:
    """Open a regular file for reading.

    Args:
        path: where it lies.
        size: its kind (`ply`), whose budget limits its bytes (`budgets.ply_bytes`); a number of bytes; or None where
            the reader itself takes no more than it has checked.
        cure: what to do about what is no such file, for the message.
        follow_links: open what a symbolic link leads to; where it may lead is for the caller to say.

    Raises:
        InputError: it is no regular file, is larger, or is a link that is not followed.
        OSError: it cannot be opened.
    """
    return os.fdopen(_opened(path, os.O_RDONLY, size, cure, follow_links), "rb")


def open_to_append(path: Path, cure: str = CURE) -> io.BufferedWriter:
    """Open a regular file for writing at its end; it is made where there is none. Links are not followed.

    Raises:
        InputError: it is no regular file.
        OSError: it cannot be opened.
    """
    return os.fdopen(_opened(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, None, cure, follow_links=False), "ab")


def read_bytes(path: Path, size: str | int, cure: str = CURE) -> bytes:
    """Return the content of a regular file, as large as it was when it was opened; `size` as of `open_regular`."""
    with explained(path, cure), open_regular(path, size, cure) as file:
        return file.read(os.fstat(file.fileno()).st_size)


def read_text(path: Path, kind: str, cure: str = CURE) -> str:
    """Return a text file of a kind (`json`) in UTF-8, or in UTF-16 with a byte order mark; ends of lines become \\n."""
    content = io.BytesIO(read_bytes(path, kind, cure))
    try:
        text = io.TextIOWrapper(content, encoding_of(content)).read()
    except UnicodeError as error:
        where = f" (byte {error.start} is not UTF-8)" if isinstance(error, UnicodeDecodeError) else ""
        raise InputError(f"{path} is not a text file{where}. {cure}") from error
    require_text_within(kind, text, path)
    return text


def read_lines(file: io.BufferedReader, encoding: str) -> Iterator[str]:
    """Return the lines of a text one at a time, each no longer than `budgets.text_bytes`: a sparse file is one line.

    Raises:
        ValueError: a longer line, or no text.
    """
    most = limits().text_bytes
    with io.TextIOWrapper(file, encoding, newline="\n") as lines:
        for number, line in enumerate(iter(lambda: lines.readline(most + 1), ""), start=1):
            if len(line) > most:
                raise ValueError(f"line {number} has more than {most:,} characters")
            yield line


class HeaderReader(io.BufferedReader):
    """Read an open file within a budget until `left` is None: a header may claim to be all of a large sparse file."""

    left: int | None

    def __init__(self, file: io.BufferedReader, left: int, budget: str, where: Path, what: str) -> None:
        super().__init__(file.raw)
        self.seek(0)
        self.left, self.refusal = left, (budget, math.inf, where, what)

    def read(self, size: int | None = -1, /) -> bytes:
        """Return the next bytes."""
        if self.left is None:
            return super().read(size)
        content = super().read(self.left + 1 if size is None or size < 0 else min(size, self.left + 1))
        self.left -= len(content)
        if self.left < 0:
            require_within(*self.refusal)
        return content


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


def _opened(path: Path, flags: int, size: str | int | None, cure: str, follow_links: bool) -> int:
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
        if isinstance(size, str):
            require_within(f"{size}_bytes", state.st_size, path, "bytes")
        elif size is not None and state.st_size > size:
            raise InputError(f"{path} has {state.st_size:,} bytes, more than the limit of {size:,}. {cure}")
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

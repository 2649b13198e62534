"""Files of untrusted folders: opened only if they are regular files of a bounded size.

An archive can contain a FIFO, which would block forever, and a link can lead to a device. So a file is opened without
blocking, and checked once it is open: it cannot be replaced in between. Callers open a file without first checking that
it exists: errors are explained here.
"""

import codecs
import io
import os
import stat
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from nerf_lightning.files.budgets import limits, require_text_within, require_within
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed

# POSIX only; Windows has neither FIFOs nor devices among its files.
NO_LINK = getattr(os, "O_NOFOLLOW", 0)
WITHOUT_WAITING = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0) | getattr(os, "O_BINARY", 0)
KINDS = {
    **{stat.S_IFDIR: "a folder", stat.S_IFIFO: "a named pipe (FIFO)", stat.S_IFSOCK: "a socket"},
    **{stat.S_IFCHR: "a device", stat.S_IFBLK: "a device", stat.S_IFLNK: "a symbolic link"},
}
CURE = "It is damaged, or was made by somebody else: replace it with an intact copy, or remove it."
MADE_AGAIN = "Remove it, and it will be made again."
MOST_NAMES = 10  # Of a folder, in a message


class UnopenedError(InputError, OSError):
    """The system does not open a file; code that handles OSError handles this, too."""


class AbsentError(UnopenedError):
    """There is no file at a path."""


def open_regular(path: Path, size: str | int | None, cure: str = CURE, follow_links: bool = True) -> io.BufferedReader:
    """Open a regular file for reading.

    Args:
        path: the file.
        size: its kind (`ply`), whose budget limits its bytes (`budgets.ply_bytes`); a number of bytes; or None if the
            reader itself reads no more than it has checked.
        cure: what to do if it is not such a file, for the message.
        follow_links: open the target of a symbolic link; the caller decides where it may lead.

    Raises:
        AbsentError: it does not exist.
        UnopenedError: the system refuses to open it.
        InputError: it is not a regular file, is larger, or is a link that is not followed.
    """
    return os.fdopen(_opened(path, os.O_RDONLY, size, cure, follow_links), "rb")


def open_to_append(path: Path, cure: str = CURE) -> io.BufferedWriter:
    """Open a regular file for appending, creating it if necessary; see `open_regular`. Links are not followed."""
    return os.fdopen(_opened(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, None, cure, follow_links=False), "ab")


def open_own(path: Path, size: str | int | None) -> io.BufferedReader:
    """Open a file in a folder of the user's own (see `open_regular`); refuse others' files and links."""
    file = open_regular(path, size, MADE_AGAIN, follow_links=False)
    try:
        require_own(path, os.fstat(file.fileno()), MADE_AGAIN)
    except InputError:
        file.close()
        raise
    return file


def require_own(path: Path, state: os.stat_result, cure: str) -> None:
    """Refuse a file or folder that someone else may have written; Windows cannot tell."""
    mode, reason = stat.S_IMODE(state.st_mode), None
    if os.name == "posix" and mode & (stat.S_IWGRP | stat.S_IWOTH):
        reason = f"can be written by others (mode {mode:04o})"
    if os.name == "posix" and state.st_uid != os.geteuid():
        reason = f"belongs to another user (number {state.st_uid})"
    if reason:
        raise InputError(f"{path} {reason}, so it may come from somebody else. {cure}")


def read_bytes(path: Path, size: str | int, cure: str = CURE) -> bytes:
    """Return the content of a regular file, with its size when it was opened; `size` as for `open_regular`."""
    with open_regular(path, size, cure) as file:
        return file.read(os.fstat(file.fileno()).st_size)


def read_text(path: Path, kind: str, cure: str = CURE) -> str:
    """Return a text file of a kind (`json`) in UTF-8, or in UTF-16 with a byte order mark; line ends become \\n."""
    content = io.BytesIO(read_bytes(path, kind, cure))
    try:
        text = io.TextIOWrapper(content, encoding_of(content)).read()
    except UnicodeError as error:
        where = f" (byte {error.start} is not UTF-8)" if isinstance(error, UnicodeDecodeError) else ""
        raise InputError(f"{path} is not a text file{where}. {cure}") from error
    require_text_within(kind, text, path)
    return text


def read_lines(file: io.BufferedReader, encoding: str, errors: str = "strict") -> Iterator[str]:
    """Yield the lines of a text, each no longer than `budgets.text_bytes`: a sparse file is one line.

    Raises:
        ValueError: a line is longer, or the file is not text.
    """
    most = limits().text_bytes
    with io.TextIOWrapper(file, encoding, errors, newline="\n") as lines:
        for number, line in enumerate(iter(lambda: lines.readline(most + 1), ""), start=1):
            if len(line) > most:
                raise ValueError(f"line {number} has more than {most:,} characters")
            yield line


def encoding_of(file: io.BufferedIOBase) -> str:
    """Return the encoding of a text file by its byte order mark: UTF-16, which Windows writes, or UTF-8."""
    start = file.read(2)
    file.seek(0)
    return "utf-16" if start in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else "utf-8-sig"


def what_is(path: Path) -> str:
    """Return what is at a path, as the rest of a sentence that begins with the path.

    >>> what_is(Path("/")), what_is(Path("/nowhere"))
    ('is a folder', 'does not exist')
    """
    try:
        return f"is {KINDS.get(stat.S_IFMT(os.stat(path).st_mode), 'a file')}"
    except PermissionError:
        return "cannot be accessed (permission denied)"
    except (OSError, ValueError):  # NUL, too long, or a loop of links
        is_link = os.path.islink(path)
        return f"is a symbolic link to {os.readlink(path)}, which leads nowhere" if is_link else "does not exist"


def contents(folder: Path) -> str:
    """Return a short list of a folder's contents: names, with their type if neither file nor folder."""
    try:
        names = sorted(os.listdir(folder))
    except (OSError, ValueError) as error:  # including a missing folder
        return f"nothing that can be read ({getattr(error, 'strerror', error)})"
    kinds = [what_is(folder / name).removeprefix("is ") for name in names[:MOST_NAMES]]
    notes = ["" if kind in ("a file", "a folder") else f" ({kind})" for kind in kinds]
    return listed([*map(str.__add__, names, notes), *names[MOST_NAMES:]], MOST_NAMES) or "nothing"


def _opened(path: Path, flags: int, size: str | int | None, cure: str, follow_links: bool) -> int:
    try:
        handle = os.open(path, flags | WITHOUT_WAITING | (0 if follow_links else NO_LINK), 0o666)
    except (OSError, ValueError) as error:
        with suppress(OSError, ValueError):  # a socket, or a pipe without a reader, cannot be opened
            _require_regular(path, os.stat(path, follow_symlinks=follow_links), None, cure)
        if isinstance(error, PermissionError) or os.path.exists(path):
            raise UnopenedError(f"{path} cannot be opened: {getattr(error, 'strerror', error)}. {cure}") from error
        held = "" if os.path.islink(path) else f"; the folder holds {contents(path.parent)}"
        raise AbsentError(f"{path} {what_is(path)}{held}. Put the file there, or give another path.") from error
    try:
        _require_regular(path, os.fstat(handle), size, cure)
    except BaseException:
        os.close(handle)
        raise
    return handle


def _require_regular(path: Path, state: os.stat_result, size: str | int | None, cure: str) -> None:
    if not stat.S_ISREG(state.st_mode):
        kind = KINDS.get(stat.S_IFMT(state.st_mode), "no regular file")
        raise InputError(f"{path} is {kind}, and only regular files are opened here. {cure}")
    if isinstance(size, str):
        require_within(f"{size}_bytes", state.st_size, path, "bytes")
    elif size is not None and state.st_size > size:
        raise InputError(f"{path} has {state.st_size:,} bytes, more than the limit of {size:,}. {cure}")

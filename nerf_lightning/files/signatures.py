"""By what a file is known: its name, and words at its beginning."""

import re
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path

from nerf_lightning.files.regular import open_regular
from nerf_lightning.messages.errors import InputError

HEAD = 1 << 16
"""Bytes of a file in which the words are looked for."""
MOST_FILES = 20
"""Of a folder whose beginnings are read for one pattern."""

Signature = tuple[str, str]
"""A pattern of names below a folder, and a regular expression that the beginning of such a file contains; "" is any."""


def file_with(folder: Path, signature: Signature) -> str | None:
    """Return the first file, in order of names, that has a signature: its path below `folder`, with /."""
    return next(files_with(folder, signature), None)


def files_with(folder: Path, signature: Signature) -> Iterator[str]:
    """Yield the files below a folder that have a signature, in order of names."""
    pattern, words = signature
    if any(mark in pattern for mark in "*?["):
        paths = sorted(path for path in folder.glob(pattern) if not path.name.startswith("."))
    else:
        paths = [folder / pattern] if (folder / pattern).exists() else []
    for path in paths[:MOST_FILES] if words else paths:
        if fits(path, signature):
            yield path.relative_to(folder).as_posix()


def fits(path: Path, signature: Signature) -> bool:
    """Return whether a file has the name and the words of a signature, wherever it lies."""
    pattern, words = signature
    return fnmatch(path.name, pattern.rpartition("/")[2]) and (not words or bool(re.search(words, beginning(path))))


def beginning(path: Path) -> str:
    """Return the beginning of a file as text, empty where it cannot be opened; what is no text becomes signs for it."""
    try:
        with open_regular(path, None) as file:
            start = file.read(HEAD)
    except (OSError, InputError):
        return ""
    return start.replace(b"\0", b"").decode("utf-8", "replace").removeprefix("\ufeff")  # UTF-16 is read, too

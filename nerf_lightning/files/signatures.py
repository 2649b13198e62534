"""Recognize files by their names, and by words or bytes at their beginning."""

import codecs
import re
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path

from nerf_lightning.files.regular import open_regular
from nerf_lightning.messages.errors import InputError

HEAD = 1 << 16
"""Bytes of a file in which the words are searched for."""
MOST_FILES = 20
"""Maximum number of files in a folder whose beginnings are read for one pattern."""

ARCHIVE, WEB_PAGE = (
    "a {} archive: unpack it, and give what it holds",
    "a web page (HTML): the download failed, repeat it",
)
ZIP, FILM = ARCHIVE.format("zip"), "a film: find its cameras with nerf poses video=FILE"
OTHERS = (
    (0, b"version https://git-lfs.", "a Git LFS pointer and not the file itself: fetch it with `git lfs pull`"),
    (0, b"/annex/objects/", "a git-annex pointer and not the file itself: fetch it with `git annex get`"),
    *((0, mark, WEB_PAGE) for mark in (b"<!doctype html", b"<html", b"<head")),
    *((0, b"pk\x03\x04", ZIP), (0, b"\x1f\x8b", ARCHIVE.format("gzip")), (0, b"rar!", ARCHIVE.format("RAR"))),
    *((0, b"7z\xbc\xaf\x27\x1c", ARCHIVE.format("7z")), (257, b"ustar", ARCHIVE.format("tar"))),
    (0, b"%pdf", "a PDF document: use the pictures that it was made from"),
    *((4, mark, FILM) for mark in (b"ftypqt", b"ftypmp4", b"ftypiso", b"ftypM4V", b"ftyp3gp", b"moov", b"wide")),
    *((8, b"AVI ", FILM), (0, b"\x1aE\xdf\xa3", FILM)),
)
"""Offsets and bytes that identify other formats; at the beginning, letters are compared in lowercase."""
ZIPS = (".npz", ".npy", ".ckpt", ".pt", ".pth")
"""Files that are, or may be, archives themselves."""

Signature = tuple[str, str]
"""A pattern of names below a folder, and a regular expression that the beginning of such a file contains; "" is any."""


def file_with(folder: Path, signature: Signature) -> str | None:
    """Return the first file, sorted by name, that has a signature: its path below `folder`, with /."""
    return next(files_with(folder, signature), None)


def files_with(folder: Path, signature: Signature) -> Iterator[str]:
    """Yield the files below a folder that have a signature, sorted by name."""
    pattern, words = signature
    if any(mark in pattern for mark in "*?["):
        paths = sorted(path for path in folder.glob(pattern) if not path.name.startswith("."))
    else:
        paths = [folder / pattern] if (folder / pattern).exists() else []
    for path in paths[:MOST_FILES] if words else paths:
        if fits(path, signature):
            yield path.relative_to(folder).as_posix()


def fits(path: Path, signature: Signature) -> bool:
    """Return whether a file has the name and the words of a signature, wherever it is."""
    pattern, words = signature
    return fnmatch(path.name, pattern.rpartition("/")[2]) and (not words or bool(re.search(words, beginning(path))))


def other_format(path: Path) -> str | None:
    """Return the actual format of a misnamed file, and the cure; None if its first bytes do not tell."""
    start = _start(path)
    text = start.removeprefix(codecs.BOM_UTF8).lstrip().lower()
    for place, mark, words in OTHERS:
        if (text if place == 0 and mark.isascii() else start[place:]).startswith(mark):
            return None if words == ZIP and path.suffix.lower() in ZIPS else words
    return None


def beginning(path: Path) -> str:
    """Return the beginning of a file as text, empty if it cannot be opened; invalid bytes are replaced."""
    text = _start(path).replace(b"\0", b"").decode("utf-8", "replace")
    return text.removeprefix("\ufeff")  # also UTF-16's


def _start(path: Path) -> bytes:
    """Return the first bytes of a file; empty if it cannot be opened."""
    try:
        with open_regular(path, None) as file:
            return file.read(HEAD)
    except (OSError, InputError):
        return b""

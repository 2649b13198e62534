"""Locate a capture's folder: the one that the user named, one below it, or the one that contains it."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from nerf_lightning.data.captures.find_pictures import PICTURE_FOLDERS, pictures_below
from nerf_lightning.files.regular import what_is
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed

PARTS = (*filter(None, PICTURE_FOLDERS), "sparse", "colmap", "0", "keyframes", "train")
"""Folders within a capture; if one of them is given, its parent is meant."""
DEEPEST, MOST_FOLDERS = 3, 1000
"""How deep below a folder, and in how many folders of a level, captures are searched for."""

Result = TypeVar("Result")


def named_folder(root: str) -> Path:
    """Return the folder that the user named, or that of the named file; raise `InputError` if there is none."""
    try:
        folder = Path(root).expanduser()
    except RuntimeError as error:
        raise InputError(f"scene.root={root}: {error}. Give the folder without ~.") from error
    if os.path.isfile(folder):
        return folder.parent
    if not os.path.isdir(folder):
        where = (
            ""
            if folder.is_absolute() or os.path.lexists(folder)
            else f" in {Path.cwd()}, where relative ones are looked for"
        )
        raise InputError(f"The folder {folder} {what_is(folder)}{where}. Set scene.root to the capture's folder.")
    return folder


def located(folder: Path, capture_in: Callable[[Path], Result | None]) -> list[Result]:
    """Return a folder's own capture, as a list of one; or the capture that contains it, or those below it.

    Args:
        folder: as named by the user.
        capture_in: returns what a folder itself contains; None if it contains no capture.
    """

    def near(path: Path) -> Result | None:
        try:
            return capture_in(path)
        except (OSError, InputError):  # not a folder that the user named
            return None

    known, part = capture_in(folder), folder.resolve()
    if known and (part.name not in PARTS or pictures_below(folder)):
        return [known]
    while part.name in PARTS:
        part = part.parent
        if whole := near(part):
            return [whole]
    found, below = [known] if known else [], [folder]
    for _ in range(0 if found else DEEPEST):
        below = [path for each in below for path in _folders_in(each)][:MOST_FOLDERS]
        found = found or [known for path in below if (known := near(path))]
    return found


def require_one(folders: Sequence[Path], root: str) -> None:
    """Refuse a folder `root` that contains several captures."""
    if len(folders) > 1:
        choice = listed((f"scene.root={path}" for path in folders), 4)
        raise InputError(f"{root} holds {len(folders)} captures. Choose one of them: {choice}.")


def _folders_in(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith(".") and path.is_dir())
    except OSError:  # not listable
        return []

"""Folders and files that nobody but the user can have written, so that their content is trusted."""

import os
import stat
from io import BufferedReader
from pathlib import Path

from nerf_lightning.files.regular import open_regular
from nerf_lightning.messages.errors import InputError

SETTING = "NERF_LIGHTNING_CACHE or scene.cache_dir"
OTHERS_MAY_WRITE = stat.S_IWGRP | stat.S_IWOTH


def make_own_folder(folder: Path, setting: str = SETTING) -> None:
    """Make a folder, and those above it that are missing, for the user alone (mode 0700).

    Raises:
        InputError: it belongs to somebody else or can be written by others; `setting` names another one.
        OSError: it cannot be made.
    """
    missing = [folder]
    while not missing[-1].parent.exists():
        missing.append(missing[-1].parent)
    for place in reversed(missing):
        place.mkdir(mode=0o700, exist_ok=True)
    reason = whose(os.stat(folder))
    if reason is not None:
        raise InputError(
            f"The folder {folder} {reason}, so its contents may come from somebody else. If you made it and everything "
            f"in it, make it private (chmod 700 '{folder}'); otherwise choose a folder of your own with {setting}."
        )


def open_own(path: Path, most_bytes: int | None) -> BufferedReader:
    """Open a regular file for reading that nobody but the user can have written, if the folder is the user's own.

    Raises:
        InputError: it belongs to somebody else, can be written by others, is a link or no regular file, or is larger.
        OSError: it cannot be opened.
    """
    file = open_regular(path, most_bytes, "Remove it, and it will be made again.", follow_links=False)
    reason = whose(os.fstat(file.fileno()))
    if reason is not None:
        file.close()
        raise InputError(f"{path} {reason}, so it may come from somebody else. Remove it, and it will be made again.")
    return file


def whose(state: os.stat_result) -> str | None:
    """Return in words what keeps a file or folder from being the user's alone, None where it is; on Windows always."""
    if os.name != "posix":
        return None
    if state.st_uid != os.geteuid():
        return f"belongs to another user (number {state.st_uid})"
    mode = stat.S_IMODE(state.st_mode)
    return f"can be written by others (mode {mode:04o})" if mode & OTHERS_MAY_WRITE else None

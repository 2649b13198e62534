"""What leads out of a folder is refused: names in a stranger's files, and links that an archive has brought."""

import os
from collections.abc import Iterator
from pathlib import Path, PurePosixPath, PureWindowsPath

from nerf_lightning.files.walk import walk
from nerf_lightning.messages.errors import InputError


def require_no_way_out(folder: Path) -> None:
    """Refuse to write into a folder with links that lead out of it: an unpacked archive may have brought them."""
    for path in _ways_out(folder):
        raise InputError(
            f"{path} is a symbolic link to {os.readlink(path)}, so writing into {folder} would write there. Remove the "
            "link (or replace it with what it points to), or give another folder with paths.output_dir=DIR."
        )


def require_nothing_from_outside(folder: Path) -> None:
    """Refuse to show a folder with links that lead out of it: what they name would be shown, and perhaps sent on."""
    for path in _ways_out(folder):
        raise InputError(
            f"{path} is a symbolic link to {os.readlink(path)}, which lies outside of {folder} and would be shown. "
            "Remove the link, or replace it with what it points to."
        )


def _ways_out(folder: Path) -> Iterator[Path]:
    root = os.path.realpath(folder)
    for base, folders, names in walk(Path(root)):
        for path in (base / name for name in (*folders, *names)):
            if path.is_symlink() and not Path(os.path.realpath(path)).is_relative_to(root):
                yield path


def is_there(path: Path) -> bool:
    """Tell whether a file can be found; one whose name no file system takes cannot."""
    return os.path.isfile(path)


def is_absolute(name: str) -> bool:
    r"""Tell whether a name begins at a root, of Windows too.

    >>> is_absolute("/home/a.jpg"), is_absolute(r"C:\a.jpg"), is_absolute("images/a.jpg")
    (True, True, False)
    """
    return PurePosixPath(name).is_absolute() or PureWindowsPath(name).is_absolute()

"""What leads out of a folder is refused: names in a stranger's files, and links that an archive has brought."""

import os
from collections.abc import Iterator
from pathlib import Path, PurePosixPath, PureWindowsPath

from nerf_lightning.files.walk import walk
from nerf_lightning.messages.errors import InputError


def require_no_way_out(folder: Path) -> None:
    """Refuse to write into a folder with links that lead out of it: an unpacked archive may have brought them.

    Raises:
        InputError: with the link.
    """
    for path in _ways_out(folder):
        raise InputError(
            f"{path} is a symbolic link to {os.readlink(path)}, and writing into {folder} would write there. "
            "Remove the link (or put what it names in its place), or give another folder with paths.output_dir=DIR."
        )


def require_nothing_from_outside(folder: Path) -> None:
    """Refuse to show a folder with links that lead out of it: what they name would be shown, and perhaps sent on.

    Raises:
        InputError: with the link.
    """
    for path in _ways_out(folder):
        raise InputError(
            f"{path} is a symbolic link to {os.readlink(path)}, which lies outside of {folder} and would be shown. "
            "Remove the link, or put what it names in its place."
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


def require_inside(path: Path, root: Path, setting: str | None = None) -> None:
    """Refuse a name that leads out of a folder; links are followed, since reading a picture or numbers does no harm.

    Args:
        path: as it was found.
        root: the capture's folder.
        setting: the user's own name of a folder below root; one that leaves it by name is the user's word.

    Raises:
        InputError: with where it leads, and the cure.
    """
    folders = [root] if setting is None or not leaves_by_name(setting) else [root, root / setting]
    named = Path(os.path.abspath(path))
    if not any(named.is_relative_to(os.path.abspath(folder)) for folder in folders):
        raise InputError(
            f"{path} leads out of the capture's folder {root}, and the names in a capture are followed inside of it "
            "only: they may be a stranger's. If this capture is yours, add scene.allow_outside=true; else copy what it "
            "needs into its folder."
        )


def leaves_by_name(name: str) -> bool:
    """Tell whether a name leaves the folder that it is looked for in.

    >>> leaves_by_name("images/../../photos"), leaves_by_name("/photos"), leaves_by_name("images/../photos")
    (True, True, False)
    """
    return is_absolute(name) or os.path.normpath(name).split(os.sep)[0] == os.pardir

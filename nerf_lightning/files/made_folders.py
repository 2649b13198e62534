"""Output folders and files: named, made, emptied and removed only here.

A name may contain untrusted text (a scene, a photograph, a setting), an unpacked archive can contain links, and the
user may have a folder with the name of one of ours. So a name never leaves its folder, links below the folder that the
user named are not followed (that folder may be a link itself: it is the user's choice), and only folders marked as made
by this program are ever emptied.
"""

import hashlib
import os
import re
import shutil
from contextlib import suppress
from pathlib import Path

from filelock import FileLock, Timeout

from nerf_lightning.files.regular import require_own
from nerf_lightning.files.walk import walk
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import is_plain, listed

MARK = ".made_by_nerf_lightning"  # An empty file in each folder that may be emptied
LOCK = "lock"
LONGEST_NAME = 200  # In bytes; file systems allow 255, and temporary names are longer
DEVICE = re.compile(r"(con|prn|aux|nul|com\d|lpt\d|conin\$|conout\$) *(\..*)?", re.IGNORECASE)  # Windows' names
CACHE_SETTING = "NERF_LIGHTNING_CACHE or scene.cache_dir"


def file_name(value: str, ending: str = "") -> str:
    r"""Return a value as a name that is valid on any file system and stays within its folder.

    >>> file_name("../a\x00:b", ".png"), file_name(".."), file_name("con.txt")
    ('.._a__b.png', '_', '_con.txt')
    """
    name = "".join("_" if letter in '/\\<>:"|?*' or not is_plain(letter) else letter for letter in value)
    if len((name + ending).encode()) > LONGEST_NAME:  # the digest distinguishes names with the same beginning
        digest = hashlib.sha256(value.encode(errors="surrogatepass")).hexdigest()[:8]
        name = f"{name.encode()[: LONGEST_NAME - 9 - len(ending)].decode(errors='ignore')}~{digest}"
    name = f"_{name}{ending}" if DEVICE.fullmatch(name + ending) else name + ending
    bare = name.rstrip(". ")  # which Windows drops
    return name if name == bare != "" else f"{bare}_"


def child_of(folder: Path, *names: str, ending: str = "") -> Path:
    """Return the path in a folder that is named by one value, or by several nested ones.

    Raises:
        InputError: a link leads there.
    """
    place = folder
    for number, name in enumerate(names, start=1):
        place = place / file_name(name, ending if number == len(names) else "")
        if place.is_symlink():
            raise InputError(
                f"{place} is a symbolic link to {place.readlink()}, so writing into {folder} would write there. Remove "
                "the link, or give another folder with paths.output_dir=DIR."
            )
    return place


def make_folder(root: Path, *names: str, new: bool = False) -> Path:
    """Make the folder that `child_of` returns, and its missing parents; an existing one is used.

    Raises:
        InputError: a link leads there.
        OSError: it cannot be made, or exists although it must be `new`.
    """
    folder = child_of(root, *names)
    folder.mkdir(parents=True, exist_ok=not new)
    return folder


def make_own_folder(folder: Path, setting: str = CACHE_SETTING) -> None:
    """Make a folder and its missing parents, accessible only to the user (mode 0700).

    Raises:
        InputError: it belongs to someone else or is writable by others; `setting` chooses another one.
        OSError: it cannot be made.
    """
    if not folder.parent.exists():
        make_own_folder(folder.parent, setting)
    folder.mkdir(mode=0o700, exist_ok=True)
    cure = (
        f"If you made it and everything in it, make it private (chmod 700 '{folder}'); otherwise choose a folder of "
        f"your own with {setting}."
    )
    require_own(folder, os.stat(folder), cure)


def require_no_way_out(folder: Path) -> None:
    """Refuse to write into a folder, or to show one, with links that lead out of it: an archive may contain them."""
    root = os.path.realpath(folder)
    for base, folders, names in walk(Path(root)):
        for path in (base / name for name in (*folders, *names)):
            if path.is_symlink() and not Path(os.path.realpath(path)).is_relative_to(root):
                raise InputError(
                    f"{path} is a symbolic link to {os.readlink(path)}, which lies outside of {folder}, so it would be "
                    "written to, or shown. Remove the link, replace it with what it points to, or give another folder "
                    "(paths.output_dir=DIR)."
                )


def remove_empty(*folders: Path) -> None:
    """Remove the empty ones of the folders, given innermost first."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def make_ours(root: Path, *names: str, files: str = "*") -> Path:
    """Make a folder like `make_folder`, mark it as ours, and allow its `files` (a pattern) to be removed.

    Raises:
        InputError: a link leads there, or it contains such files without a mark.
    """
    folder = make_folder(root, *names)
    if not (folder / MARK).is_file():
        theirs = sorted(path.name for path in folder.glob(files) if path.name != LOCK)
        if theirs:
            raise InputError(
                f"{folder} holds {listed(theirs, 3)}, not made by this program, which would remove it. Move it away, "
                "or give another folder with paths.output_dir=DIR."
            )
        (folder / MARK).touch()
    return folder


def empty_ours(folder: Path, files: str = "*") -> None:
    """Remove the `files` from a folder of `make_ours`; links in it are removed, and their targets stay."""
    if (folder / MARK).is_file() and not folder.is_symlink():
        for path in folder.glob(files):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            elif path.name not in (MARK, LOCK):
                path.unlink()


def require_run(folder: Path) -> None:
    """Refuse to write to a run folder that no longer exists."""
    if not (folder / "run.json").is_file():
        raise InputError(
            f"The run folder {folder} was deleted, moved or renamed during the run, so the run stops here. If the "
            "folder has another name now, continue with resume=NEW_NAME."
        )


class ScratchFolder:
    """A folder for unfinished files in an output folder; one process holds it, and removes it at the end.

    Args:
        root: the output folder.
        name: of the folder in it.
        doing: what the holding process does there, for the message in another one.
    """

    def __init__(self, root: Path, name: str, doing: str) -> None:
        self.root, self.path, self.doing = root, root / name, doing
        self.lock = FileLock(self.path / LOCK)

    def hold(self) -> None:
        """Make it, and lock others out. Files that a killed process left in it stay.

        Raises:
            InputError: another process holds it, a link leads there, or it contains files not made by this program.
            OSError: it cannot be made.
        """
        make_ours(self.root, self.path.name)
        child_of(self.path, LOCK)
        try:
            self.lock.acquire(timeout=0)
        except Timeout as error:
            raise InputError(
                f"{self.root} is in use by another process that {self.doing} there. Wait for it, stop it, or give "
                "another folder with paths.output_dir=DIR."
            ) from error

    def release(self) -> None:
        """Release it to others, with its contents."""
        self.lock.release()

    def remove(self) -> None:
        """Remove it, as far as possible, while it is held: the lock file last, since others may then enter."""
        with suppress(OSError):
            empty_ours(self.path)
            (self.path / MARK).unlink()
            (self.path / LOCK).unlink()
        self.release()
        remove_empty(self.path)

"""Places that are written to: named, made, emptied and removed here alone.

A name may hold what anybody has chosen (a scene, a photograph, a setting), an unpacked archive can bring links, and a
person may have a folder of the name that we give to one of ours. So a name leads nowhere, nothing is reached through a
link below the folder that the user named (which may be a link itself: it is the user's own word), and only a folder in
which a file says that this program made it is ever emptied.
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
LONGEST_NAME = 200  # In bytes; file systems take 255, and temporary names are longer
DEVICE = re.compile(r"(con|prn|aux|nul|com\d|lpt\d|conin\$|conout\$) *(\..*)?", re.IGNORECASE)  # Windows' names
CACHE_SETTING = "NERF_LIGHTNING_CACHE or scene.cache_dir"


def file_name(value: str, ending: str = "") -> str:
    r"""Return a value as a name that any file system takes for a file or folder in the folder that it is put into.

    >>> file_name("../a\x00:b", ".png"), file_name(".."), file_name("con.txt")
    ('.._a__b.png', '_', '_con.txt')
    """
    name = "".join("_" if letter in '/\\<>:"|?*' or not is_plain(letter) else letter for letter in value)
    if len((name + ending).encode()) > LONGEST_NAME:  # the digest keeps names apart that begin alike
        digest = hashlib.sha256(value.encode(errors="surrogatepass")).hexdigest()[:8]
        name = f"{name.encode()[: LONGEST_NAME - 9 - len(ending)].decode(errors='ignore')}~{digest}"
    name = f"_{name}{ending}" if DEVICE.fullmatch(name + ending) else name + ending
    bare = name.rstrip(". ")  # which Windows leaves out
    return name if name == bare != "" else f"{bare}_"


def child_of(folder: Path, *names: str, ending: str = "") -> Path:
    """Return the place in a folder that is called by a value, or by several, each within the one before.

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
    """Make the folder that `child_of` returns, and those around it that are missing; one that exists is taken.

    Raises:
        InputError: a link leads there.
        OSError: it cannot be made, or exists and is to be `new`.
    """
    folder = child_of(root, *names)
    folder.mkdir(parents=True, exist_ok=not new)
    return folder


def make_own_folder(folder: Path, setting: str = CACHE_SETTING) -> None:
    """Make a folder, and those above it that are missing, for the user alone (mode 0700).

    Raises:
        InputError: it belongs to somebody else or can be written by others; `setting` names another one.
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
    """Refuse to write into a folder, or to show one, with links that lead out of it: an archive may bring them."""
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
    """Remove those of the folders that hold nothing, the innermost given first."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def make_ours(root: Path, *names: str, files: str = "*") -> Path:
    """Make a folder as `make_folder` does, whose `files` (a pattern) will be removed again, and mark it as ours.

    Raises:
        InputError: a link leads there, or it has such files and no mark.
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
    """Remove what `make_ours` was told of from the folder that it made; links in it go, and what they lead to stays."""
    if (folder / MARK).is_file() and not folder.is_symlink():
        for path in folder.glob(files):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            elif path.name not in (MARK, LOCK):
                path.unlink()


def require_run(folder: Path) -> None:
    """Refuse to write to the folder of a run that is gone."""
    if not (folder / "run.json").is_file():
        raise InputError(
            f"The run folder {folder} was deleted, moved or renamed during the run, so the run stops here. If the "
            "folder has another name now, continue with resume=NEW_NAME."
        )


class ScratchFolder:
    """A folder for what is unfinished, in an output folder; one process holds it, and removes it in the end.

    Args:
        root: the output folder.
        name: of the folder in it.
        doing: what the process that holds it does there, for the message of another one.
    """

    def __init__(self, root: Path, name: str, doing: str) -> None:
        self.root, self.path, self.doing = root, root / name, doing
        self.lock = FileLock(self.path / LOCK)

    def hold(self) -> None:
        """Make it, and keep others out. What a process that was killed left in it stays.

        Raises:
            InputError: another process holds it, a link leads there, or it holds what this program has not made.
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
        """Let others have it, with what is in it."""
        self.lock.release()

    def remove(self) -> None:
        """Remove it, as far as that can be, while it is held: the lock's file last, since then others may come."""
        with suppress(OSError):
            empty_ours(self.path)
            (self.path / MARK).unlink()
            (self.path / LOCK).unlink()
        self.release()
        remove_empty(self.path)

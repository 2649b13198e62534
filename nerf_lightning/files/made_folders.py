"""Folders that are written into are made here, and emptied and removed here alone.

An unpacked archive can bring links, and a person may have a folder of the name that we give to one of ours. So nothing
is reached through a link below the folder that the user named (which may be a link itself: it is the user's own word),
and only a folder in which a file says that this program made it is ever emptied.
"""

import shutil
from contextlib import suppress
from pathlib import Path

from filelock import FileLock, Timeout

from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed

MARK = ".made_by_nerf_lightning"  # An empty file in each folder that may be emptied
LOCK = "lock"


def below(root: Path, *names: str) -> Path:
    """Return a place in a folder that the user named (it may be a link), which is reached through no link."""
    place = root
    for name in names:
        place = place / name
        if place.is_symlink():
            raise InputError(
                f"{place} is a symbolic link to {place.readlink()}, so writing into {root} would write there. Remove "
                "the link, or give another folder with paths.output_dir=DIR."
            )
    return place


def make_folder(root: Path, *names: str) -> Path:
    """Make a folder as `below` returns it, and those around it that are missing; one that is there is taken.

    Raises:
        InputError: a link leads there.
        OSError: it cannot be made.
    """
    folder = below(root, *names)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def make_new_folder(folder: Path) -> None:
    """Make a folder of a name that nothing has, and those around it that are missing."""
    folder.mkdir(parents=True)


def remove_empty(*folders: Path) -> None:
    """Remove those of the folders that hold nothing, the innermost given first."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def make_ours(root: Path, *names: str, files: str = "*") -> Path:
    """Make a folder as `below` returns it, whose `files` (a pattern) will be removed again, and mark it as ours.

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
        below(self.path, LOCK)
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

"""Walk folders of any depth: Python's own `os.walk` (up to 3.11) and `rglob` recurse."""

import os
from collections.abc import Iterator
from pathlib import Path


def walk(root: Path, through_links: bool = False) -> Iterator[tuple[Path, list[str], list[str]]]:
    """Yield each folder, the folders in it and the other names in it, the folder itself first, as `os.walk` does.

    Links to folders are listed, and followed only `through_links`, each folder once, so that a loop of links ends;
    unreadable folders are skipped. Folders that the caller removes from the list are not entered, and the caller may
    reorder it.
    """
    waiting, entered = [root], set[str]()
    while waiting:
        base = waiting.pop()
        if through_links:
            if (real := os.path.realpath(base)) in entered:
                continue
            entered.add(real)
        folders, names = list[str](), list[str]()
        try:
            with os.scandir(base) as entries:
                for entry in entries:
                    is_folder = os.path.isdir(entry) if entry.is_symlink() else entry.is_dir()
                    (folders if is_folder else names).append(entry.name)
        except OSError:
            continue
        yield base, folders, names
        waiting += [base / name for name in reversed(folders) if through_links or not os.path.islink(base / name)]

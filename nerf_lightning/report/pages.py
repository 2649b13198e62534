"""The pages of a run's scene, to be linked: where they lie, and their address from another file."""

import os
from pathlib import Path
from urllib.parse import quote

from nerf_lightning.export.page_file import is_page

PLACES = ("page.html", "export/page.html")
"""Of a run folder: where final.page and nerf export write it."""


def page_of_run(run: Path) -> Path | None:
    """Return the newest page of a run's scene; None where there is none."""
    found = [file for place in PLACES if (file := run / place).is_file() and is_page(file)]
    return max(found, key=lambda file: file.stat().st_mtime, default=None)


def address_from(file: Path, folder: Path) -> str:
    """Return a file's address for a page in a folder, relative to it: both may be moved together.

    >>> address_from(Path("/runs/a b/page.html"), Path("/runs/gallery"))
    './../a%20b/page.html'
    """
    # Behind a dot, no name is taken for a scheme such as javascript.
    return f"./{quote(os.fsencode(Path(os.path.relpath(file, folder)).as_posix()))}"

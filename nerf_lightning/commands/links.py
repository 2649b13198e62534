"""Links in a folder that is written to: an unpacked archive may have brought some that lead elsewhere."""

import os
from pathlib import Path

from nerf_lightning.errors import InputError


def require_no_way_out(folder: Path) -> None:
    """Refuse to write into a folder with links that lead out of it: an unpacked archive may have brought them.

    Raises:
        InputError: with the link.
    """
    root = os.path.realpath(folder)
    for base, folders, names in os.walk(root):
        for path in (Path(base) / name for name in (*folders, *names)):
            if path.is_symlink() and not Path(os.path.realpath(path)).is_relative_to(root):
                raise InputError(
                    f"{path} is a symbolic link to {os.readlink(path)}, and writing into {folder} would write there. "
                    "Remove the link (or put what it names in its place), or give another folder with "
                    "paths.output_dir=DIR."
                )

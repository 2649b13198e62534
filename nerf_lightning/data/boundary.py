"""The capture's folder as a boundary: what a stranger's files name, and where links lead, stays inside.

A transforms.json, a COLMAP model or an unpacked archive may come from anybody, and may name, or link to, any picture of
the one who reads it. So names in files that leave the folder (by `..`, as absolute paths, or through symbolic links)
are refused until the user says `scene.allow_outside=true`. The folder itself may be a link, and what the user's own
settings name (`scene.images=../photos`) may lie anywhere.
"""

import os
from pathlib import Path

from nerf_lightning.data.checks import is_absolute
from nerf_lightning.errors import InputError


def require_inside(path: Path, root: Path, setting: str | None = None) -> None:
    """Refuse a file or folder that is really somewhere else.

    Args:
        path: as it was found.
        root: the capture's folder.
        setting: the user's own name of a folder below root; one that leaves it by name is the user's word.

    Raises:
        InputError: with where it leads, and the cure.
    """
    folders = [root] if setting is None or not leaves_by_name(setting) else [root, root / setting]
    real = Path(os.path.realpath(path))
    if not any(real.is_relative_to(os.path.realpath(folder)) for folder in folders):
        raise InputError(
            f"{path} leads to {real}, outside of the capture's folder {root}, and where a capture's files or links "
            "lead is followed inside of it only: they may be a stranger's. If this capture is yours, add "
            "scene.allow_outside=true; else copy what it needs into its folder."
        )


def leaves_by_name(name: str) -> bool:
    """Tell whether a name leaves the folder that it is looked for in.

    >>> leaves_by_name("images/../../photos"), leaves_by_name("/photos"), leaves_by_name("images/../photos")
    (True, True, False)
    """
    return is_absolute(name) or os.path.normpath(name).split(os.sep)[0] == os.pardir

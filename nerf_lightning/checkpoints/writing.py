"""Checkpoint files that are complete at every moment: a crash leaves the old one or the new one, never half of one.

When they are written: `training/callbacks/checkpoints.py`. Their names: `format.py`.
"""

import os
from pathlib import Path
from typing import Any

import torch

from nerf_lightning.checkpoints.format import LAST, PREVIOUS
from nerf_lightning.files.atomic import FULL, persistently, whole_file
from nerf_lightning.messages.errors import InputError


def write_checkpoint(checkpoint: dict[str, Any], target: Path) -> None:
    """Write the whole file and flush it to disk before it takes its name.

    `last.ckpt` becomes `previous.ckpt` before the new one takes its name. Lightning itself writes through the system's
    temporary folder, and a move across file systems is not atomic.

    Raises:
        InputError: the disk is full or the folder cannot be written; the former checkpoint is unchanged.
    """
    try:
        target.parent.mkdir(exist_ok=True)  # not the run folder: a deleted or renamed one is not recreated
        with whole_file(target) as part:
            with part.open("wb") as file:
                torch.save(checkpoint, file)
                file.flush()
                os.fsync(file.fileno())
            if target.name == LAST and target.exists():
                _keep(target, target.with_name(PREVIOUS))
        _sync_folder(target.parent)
    except (OSError, RuntimeError) as error:
        raise _cannot_save(target, error) from error


def _keep(last: Path, previous: Path) -> None:
    """Give a checkpoint a second name, so that it always has one; `previous` is replaced."""
    persistently(lambda: previous.unlink(missing_ok=True))
    try:
        os.link(last, previous)
    except OSError:
        # A file system without links. A crash right now leaves only `previous`, which readers then use.
        persistently(os.replace, last, previous)


def _cannot_save(target: Path, error: OSError | RuntimeError) -> InputError:
    if isinstance(error, RuntimeError) and isinstance(error.__context__, OSError):
        error = error.__context__  # torch closes what it could not write, and complains about that
    kept = f"The previous checkpoint {target} is intact. " if target.exists() else ""
    full = isinstance(error, OSError) and error.errno in FULL
    cure = "Free some space" if full else f"Make sure that there is free space and that {target.parent} is writable"
    return InputError(
        f"The checkpoint {target} could not be saved: {error}. {kept}{cure}, then continue with "
        f"resume={target.parent.parent}."
    )


def _sync_folder(folder: Path) -> None:
    # A rename survives a power cut only once the folder is on disk; Windows cannot open folders.
    if os.name == "posix":
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)

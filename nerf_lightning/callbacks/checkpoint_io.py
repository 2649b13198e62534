"""Checkpoints written so that a crash at any moment leaves either the old file or the new one, never half of one."""

import errno
import os
import tempfile
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.plugins import TorchCheckpointIO

from nerf_lightning.errors import InputError


class AtomicCheckpointIO(TorchCheckpointIO):
    """Write to a temporary file in the same folder, force it to the disk, then rename.

    Lightning's own way goes through the system's temporary folder, and a move across file systems is not atomic.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write the checkpoint, or leave the former one as it was.

        Raises:
            InputError: the disk is full or the folder cannot be written.
        """
        target = Path(path)
        temporary = None
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".tmp")
            with os.fdopen(handle, "wb") as file:
                torch.save(checkpoint, file)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, target)
            _sync_folder(target.parent)
        except BaseException as error:
            if temporary is not None and os.path.exists(temporary):
                os.unlink(temporary)
            if isinstance(error, (OSError, RuntimeError)):
                raise _cannot_save(target, error) from error
            raise


def sweep_leftovers(folder: Path) -> None:
    """Remove the temporary files that a killed process left in a checkpoint folder."""
    for leftover in folder.glob(".*.ckpt.*.tmp"):
        leftover.unlink(missing_ok=True)


def _cannot_save(target: Path, error: OSError | RuntimeError) -> InputError:
    kept = f"The former checkpoint {target} is unharmed. " if target.exists() else ""
    full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
    cure = "Free some space" if full else f"See that there is space and that {target.parent} can be written"
    return InputError(
        f"The checkpoint {target} could not be saved: {error}. {kept}{cure}, "
        f"then go on with resume={target.parent.parent}."
    )


def _sync_folder(folder: Path) -> None:
    # A rename is safe against a power cut only once the folder is on the disk; Windows cannot open folders.
    if os.name == "posix":
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)

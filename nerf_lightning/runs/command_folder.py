"""Output folders of commands that do not train: the user's choice, or next to the checkpoint.

The default folder's name is in the command's own file, in `commands/`.
"""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from nerf_lightning.files.atomic import full_disk_named
from nerf_lightning.files.made_folders import make_folder, remove_empty, require_no_way_out
from nerf_lightning.messages.errors import InputError
from nerf_lightning.runs.run_folder import job_folder


def beside_checkpoint(checkpoint: Path, name: str) -> Path:
    """Return the folder of this name in a checkpoint's run folder."""
    beside = checkpoint.absolute().parent
    return (beside.parent if beside.name == "checkpoints" else beside) / name


def chosen_folder(output_dir: str | None, default: Path) -> Path:
    """Return the output folder of a command that does not train: `output_dir`, or the default. Nothing is made yet.

    The jobs of a sweep have folders of their own.

    Raises:
        InputError: it contains links that lead out of it.
    """
    if output_dir is None:
        # Next to an untrusted checkpoint.
        require_no_way_out(default.parent if default.is_symlink() else default)
    return job_folder() or Path(output_dir or default)


def output_folder(output_dir: str | None, default: Path) -> Path:
    """Make the folder that `chosen_folder` returns, check that it is writable, and return it."""
    folder = chosen_folder(output_dir, default)
    try:
        make_folder(folder)
        # With an unpredictable name, so that no link can have been planted there.
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".", suffix=".probe"):
            pass
    except OSError as error:
        raise InputError(
            f"The output folder {folder} cannot be written: {error}. Give another one with paths.output_dir=DIR."
        ) from error
    return folder


@contextmanager
def filled_folder(output_dir: str | None, default: Path) -> Iterator[Path]:
    """Yield the folder that `output_folder` returns; remove newly made folders that are empty at the end."""
    wanted = chosen_folder(output_dir, default).absolute()
    made = [folder for folder in (wanted, *wanted.parents) if not folder.exists()]
    try:
        with full_disk_named(wanted):
            yield output_folder(output_dir, default)
    finally:
        remove_empty(*made)

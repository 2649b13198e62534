"""Where a command that does not train writes: as the user says, or beside the checkpoint."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from nerf_lightning.files.atomic import full_disk_named
from nerf_lightning.files.made_folders import make_folder, remove_empty, require_no_way_out
from nerf_lightning.messages.errors import InputError
from nerf_lightning.runs.run_folder import job_folder


def beside_checkpoint(checkpoint: Path, name: str) -> Path:
    """Return the folder of this name in the run folder that a checkpoint lies in."""
    beside = checkpoint.absolute().parent
    return (beside.parent if beside.name == "checkpoints" else beside) / name


def chosen_folder(given: str | None, default: Path) -> Path:
    """Return where a command that does not train is to write: as given, else by default. Nothing is made yet.

    The jobs of a sweep have folders of their own.

    Raises:
        InputError: links lead out of it.
    """
    if given is None:
        # Beside a checkpoint that may come from anybody.
        require_no_way_out(default.parent if default.is_symlink() else default)
    return job_folder() or Path(given or default)


def output_folder(given: str | None, default: Path) -> Path:
    """Return the folder that `chosen_folder` names, made and tried."""
    folder = chosen_folder(given, default)
    try:
        make_folder(folder)
        # Under a name that nobody can have planted a link at.
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".", suffix=".probe"):
            pass
    except OSError as error:
        raise InputError(
            f"The output folder {folder} cannot be written: {error}. Give another one with paths.output_dir=DIR."
        ) from error
    return folder


@contextmanager
def filled_folder(given: str | None, default: Path) -> Iterator[Path]:
    """Lend the folder that `output_folder` returns; what was made of it and is empty at the end is removed again."""
    wanted = chosen_folder(given, default).absolute()
    made = [folder for folder in (wanted, *wanted.parents) if not folder.exists()]
    try:
        with full_disk_named(wanted):
            yield output_folder(given, default)
    finally:
        remove_empty(*made)

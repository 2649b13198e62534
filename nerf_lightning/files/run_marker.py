"""A run folder is known by its run.json: where that is gone, the run was deleted, moved or renamed."""

from pathlib import Path

from nerf_lightning.messages.errors import InputError


def require_run(folder: Path) -> None:
    """Refuse to write to the folder of a run that is gone.

    Raises:
        InputError: there is no run in it any more.
    """
    if not (folder / "run.json").is_file():
        raise InputError(
            f"The run folder {folder} was deleted, moved or renamed while the run was going on, so it stops here. If "
            "the folder has another name now, go on with resume=NEW_NAME."
        )

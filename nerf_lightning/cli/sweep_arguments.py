"""Arguments of a sweep: its folder, a folder per job named after the swept values, its original arguments."""

import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from nerf_lightning.cli.quoting import unquoted
from nerf_lightning.files.folders import option_names
from nerf_lightning.messages.errors import InputError

if TYPE_CHECKING:
    from nerf_lightning.runs.sweep_record import SweepRecord

FLAGS = ("-m", "--multirun")
FOLDER_KEYS = ("paths.output_dir", "hydra.sweep.dir")
JOB_FOLDER = "hydra.sweep.subdir"


def is_sweep(arguments: list[str]) -> bool:
    """Return whether the arguments ask for many runs."""
    return bool(set(FLAGS) & set(arguments))


def sweep_arguments(arguments: list[str]) -> list[str]:
    """Return the arguments of a sweep with its folders added; those of a single run are returned unchanged.

    `paths.output_dir` names the folder of the whole sweep, and each job's folder is named after the swept values. With
    `sweep.resume=true`, the sweep's original arguments come first.

    >>> sweep_arguments(["-m", "seed=0,1", "paths.output_dir=out"])
    ['-m', 'seed=0,1', 'hydra.sweep.dir=out', 'hydra.sweep.subdir=\\'${file_name:"${hydra.job.num}_seed=${seed}"}\\'']
    """
    resuming = (_value(arguments, "sweep.resume") or "").lower() == "true"
    if not is_sweep(arguments):
        if resuming:
            raise InputError("sweep.resume=true resumes a sweep: add -m. To resume a single run, use resume=auto.")
        return arguments
    if _value(arguments, "hydra/launcher") == "slurm" and shutil.which("srun") is None:
        raise InputError(
            "hydra/launcher=slurm submits its jobs with Slurm's srun, which is not found here. Start the sweep where "
            "srun is (a login node of the cluster), or run its jobs on this machine: hydra/launcher=parallel."
        )
    from nerf_lightning.config.hydra_versions import SWEEPS_REMOVE, register_resolver
    from nerf_lightning.files.made_folders import file_name

    register_resolver("file_name", file_name)  # Hydra passes it to the jobs
    # Hydra reads -m only before the overrides.
    arguments = ["-m", *_with_former([word for word in arguments if word not in FLAGS], resuming)]
    removed = [word for word in arguments if word.startswith("~") and "=" not in word]
    if removed and not SWEEPS_REMOVE:
        raise InputError(
            f"The installed release candidate of Hydra 1.4 cannot remove settings in a sweep ({removed[0]}). Install "
            "Hydra 1.3: pip install 'hydra-core<1.4'."
        )
    renamed = [argument.replace("paths.output_dir=", "hydra.sweep.dir=", 1) for argument in arguments]
    current = {key: f"hydra.runtime.choices.{key}" if option_names(key) else key for key in _swept(arguments)}
    parts = ["${hydra.job.num}", *(f"{key}=${{{value}}}" for key, value in current.items())]
    # A value may contain anything, and may be from the sweep's folder: no job's folder is deeper, or elsewhere.
    name = (_value(arguments, JOB_FOLDER) or "_".join(parts)).replace("'", "").replace('"', "")
    others = [argument for argument in renamed if not argument.startswith(f"{JOB_FOLDER}=")]
    return [*others, f"{JOB_FOLDER}='${{file_name:\"{name}\"}}'"]


def _with_former(arguments: list[str], resuming: bool) -> list[str]:
    """Prepend the sweep's original arguments to the user's own."""
    from nerf_lightning.compute.slurm import was_requeued
    from nerf_lightning.files.made_folders import require_no_way_out

    folder = _value(arguments, *FOLDER_KEYS)
    if folder is None and was_requeued() and not resuming:
        found = _folder_of_this_slurm_job(arguments)
        folder = None if found is None else str(found)
        arguments = arguments if found is None else [*arguments, f"paths.output_dir='{found}'"]
    if folder is not None:
        require_no_way_out(Path(folder))
    return _resumed(arguments, folder) if resuming else arguments


def _resumed(arguments: list[str], folder: str | None) -> list[str]:
    from nerf_lightning.runs.saved_overrides import former_sweep

    if folder is None:
        newest = next((str(folder) for folder, _ in _sweeps(arguments)), "DIR")
        raise InputError(
            "sweep.resume=true needs the folder of the sweep to resume. Add paths.output_dir=DIR; the newest is "
            f"paths.output_dir={newest}."
        )
    former = former_sweep(Path(folder), arguments)
    if not former and not _swept(arguments):
        raise InputError(
            f"sweep.resume=true: {folder} holds no sweep (no .hydra/sweep.yaml). Give the folder of one, or the full "
            "command, with the values to sweep, to start one there."
        )
    return [*former, *arguments]


def _folder_of_this_slurm_job(arguments: list[str]) -> Path | None:
    from nerf_lightning.compute.slurm import slurm_job
    from nerf_lightning.config.overrides import open_sections
    from nerf_lightning.runs.sweep_record import MADE

    asked = set(open_sections(argument for argument in arguments if not argument.startswith(("-", *MADE))))
    same = (f for f, record in _sweeps(arguments) if record.slurm_job == slurm_job() and set(record.typed()) == asked)
    return next(same, None)


def _sweeps(arguments: list[str]) -> Iterator[tuple[Path, "SweepRecord"]]:
    """Yield the folders of earlier sweeps, newest first, each with its record; skip damaged ones."""
    from nerf_lightning.runs.sweep_record import read_sweep

    root = Path(_value(arguments, "paths.root_dir") or "outputs") / "sweeps"
    records = root.glob("*/.hydra/sweep.yaml")
    for file in sorted(records, key=lambda file: file.stat().st_mtime, reverse=True):
        with suppress(InputError):
            record = read_sweep(file.parent.parent)
            if record is not None:
                yield file.parent.parent, record


def _value(arguments: list[str], *keys: str) -> str | None:
    pairs = [argument.partition("=") for argument in arguments]
    values = [unquoted(value) for key, _, value in pairs if key in keys]
    return values[-1] if values else None


def _swept(arguments: list[str]) -> list[str]:
    pairs = [argument.partition("=") for argument in arguments]
    return [
        key
        for key, _, values in pairs
        if ("," in values or "(" in values) and not set("/[{@~+") & set(key + values) and unquoted(values) == values
    ]

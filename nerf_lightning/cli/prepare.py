"""Add what a run, a sweep or a checkpoint remembers to a command's arguments before Hydra composes them.

Heavy modules are imported late: `--help` needs none of them.
"""

import logging
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from nerf_lightning.cli.arguments import named_paths, unquoted
from nerf_lightning.cli.process import quick_imports
from nerf_lightning.compute.slurm import was_requeued
from nerf_lightning.config.help.catalogue import Command, command_named
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


log = logging.getLogger(__name__)


def prepared(command: str, arguments: list[str]) -> list[str]:
    """Return a command's arguments, preceded by the remembered ones; the user's own come last and take precedence."""
    known = command_named(command)
    if known is not None and known.path_setting is not None:
        arguments = named_paths(arguments, known.path_setting)
    if command in PREPARED:
        return PREPARED[command](arguments)
    return arguments if known is None else _of_run(known, arguments)


def _train(arguments: list[str]) -> list[str]:
    """Repeat a run's original overrides if it is resumed by name; accept Lightning's arguments."""
    _refuse_second_sweep(arguments)
    resumed = [argument.partition("=")[2] for argument in arguments if argument.startswith("resume=")]
    from nerf_lightning.config.overrides import open_sections

    arguments = open_sections(arguments)
    if not resumed or resumed[-1] in ("auto", "null"):
        return arguments
    path = Path(unquoted(resumed[-1]))
    folder = path.parent.parent if path.suffix == ".ckpt" else path
    from nerf_lightning.runs.saved_overrides import former_overrides

    return [*former_overrides(folder, arguments), *arguments]


def _refuse_second_sweep(arguments: list[str]) -> None:
    values = dict(argument.partition("=")[::2] for argument in arguments)
    folder = Path(unquoted(values.get("hydra.sweep.dir", "")))
    goes_on = values.get("sweep.resume", "").lower() == "true" or was_requeued()
    if "hydra.sweep.dir" in values and not goes_on and next(folder.glob("*/run.json"), None) is not None:
        raise InputError(
            f"{folder} already holds runs of a sweep. Add sweep.resume=true to resume it or to add to it, or give "
            "another folder with paths.output_dir=DIR."
        )


def _eval(arguments: list[str], path_setting: str = "ckpt") -> list[str]:
    """Add the run's own scene if the user names none, so that the checkpoint suffices.

    The scene's class comes from our conf/, by the name that the checkpoint recorded; only plain values (paths, sizes,
    background) are taken from the file.
    """
    given = [argument.partition("=") for argument in arguments]
    checkpoints = [value for key, _, value in given if key == path_setting]
    if not checkpoints or any(key in ("scene", "--help") for key, _, _ in given):
        return arguments
    checkpoint = unquoted(checkpoints[-1])
    if "," in checkpoint and checkpoint == checkpoints[-1]:
        raise InputError("A sweep over checkpoints needs the scene by name: add scene=... and its settings.")
    with quick_imports():
        from nerf_lightning.config.scene_overrides import scene_overrides

    return [*scene_overrides(checkpoint), *arguments]


def _of_run(command: Command, arguments: list[str]) -> list[str]:
    """Add the run's own scene to a command that reads one; if it is unknown, do without, unless it is asked for."""
    if "scene" not in command.groups or command.path_setting is None:
        return arguments
    if "photographs" not in {setting.key for setting in command.written}:
        with suppress(InputError):  # the command says what it lacks
            return _eval(arguments, command.path_setting)
        return arguments
    wished = [value for key, _, value in (each.partition("=") for each in arguments) if key == "photographs"]
    if "true" in map(str.lower, wished[-1:]):
        return _eval(arguments)
    said = "" if wished else "The cameras are shown without their photographs"
    return _eval_or_without(arguments, ["photographs=false"], said)


def _export(arguments: list[str]) -> list[str]:
    """Add the run's own scene as for `eval` if the exporter needs photographs; if it is unknown, do without."""
    typed = [value for key, _, value in (each.partition("=") for each in arguments) if key == "what"]
    with quick_imports():
        from nerf_lightning.config.exporters import exporter_class

        if not typed:
            command = command_named("export")
            assert command is not None
            typed = [str(dict(command.groups)["what"])]
        name = typed[-1]
        exporter = exporter_class(name)
    # The user's own exporter is unknown here: it may need photographs.
    if exporter is not None and not getattr(exporter, "needs_photographs", False):
        return arguments
    return _eval_or_without(arguments, ["photographs=false"], f"what={name} does not use photographs")


def _eval_or_without(arguments: list[str], without: list[str], said: str) -> list[str]:
    """Add the run's own scene as for `eval`; if it is unknown, log `said` (unless empty) and do without."""
    try:
        return _eval(arguments)
    except InputError as error:
        from nerf_lightning.config.scene_overrides import UnknownScene

        if not isinstance(error, UnknownScene):
            raise
        if said:
            log.warning("%s: %s", said, error)
        return [*without, *arguments]


PREPARED: dict[str, Callable[[list[str]], list[str]]] = {
    "train": _train,
    "eval": _eval,
    "export": _export,
    "render": lambda arguments: arguments,  # needs the checkpoint alone
}

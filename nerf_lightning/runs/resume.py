"""Find the run that a command resumes, and check that its settings agree (`identity` in `config/setting_rules.py`).

`checkpoints.reading.newest_checkpoint` chooses among its checkpoints.
"""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from nerf_lightning.config.instantiate import required_path
from nerf_lightning.config.overrides import leaves, to_type
from nerf_lightning.config.setting_rules import fingerprint
from nerf_lightning.files.json_files import number
from nerf_lightning.files.regular import what_is
from nerf_lightning.files.yaml_files import read_plain_yaml
from nerf_lightning.messages.errors import InputError
from nerf_lightning.runs.identity import run_identity
from nerf_lightning.runs.summary import folders_of_runs, read_note

log = logging.getLogger(__name__)

UNKNOWN = "unknown"  # Placeholder for the value of a setting that a config does not have


def run_to_resume(path: Path) -> Path:
    """Return the run folder that `resume=PATH` names: a run folder, or a checkpoint in one.

    Raises:
        InputError: there is no such checkpoint or run.
    """
    folder = path.parent.parent if path.suffix == ".ckpt" else path
    if path.suffix == ".ckpt" and not path.is_file():
        raise InputError(f"resume={path}: {path} {what_is(path)}. A run keeps last.ckpt and best.ckpt.")
    if not (folder / "run.json").is_file():
        raise InputError(
            f"resume={path}: there is no run in {folder} (no run.json). Give a run folder, a checkpoint in one, or "
            "resume=auto for the newest unfinished run of this config."
        )
    return folder


def require_same_run(folder: Path, identity: dict[str, Any], typed: set[str], resuming: bool) -> None:
    """Refuse a folder whose run has other settings, or the same ones if it must not be resumed.

    Settings that were introduced after the run began may be added.

    Args:
        folder: of the existing run.
        identity: the settings that define a run (`run_identity`), of this command.
        typed: the settings on the command line.
        resuming: whether to resume the existing run.

    Raises:
        InputError: the folder contains another run, the same one although it must not be resumed, or a damaged
            `run.json`.
    """
    begun_with, note = read_note(folder).get("fingerprint"), folder / "run.json"
    if begun_with is None:
        raise InputError(
            f"{note} is {'damaged' if note.stat().st_size else 'empty'}, so it does not say which run this is. Remove "
            f"it; a run with the same settings (.hydra/overrides.yaml) and {to_type('paths.output_dir', str(folder))} "
            "then resumes from its checkpoints. Or give another folder with paths.output_dir=DIR."
        )
    other = _former_identity(folder)
    older = isinstance(other, dict) and identity == other and _is_as_begun(folder, other)
    if begun_with == fingerprint(identity) or older:
        if resuming:
            return
        raise InputError(
            f"{folder} already contains a run with these settings. Add resume=auto to resume it, or give another "
            "folder with paths.output_dir=DIR."
        )
    newer = _newer_settings(folder, identity, other) if isinstance(other, dict) and resuming else []
    if newer and not typed & set(newer):
        shown = ", ".join(f"{key}={identity[key]}" for key in newer)
        log.warning("The run in %s was started before these settings existed, and continues with %s.", folder, shown)
        return
    difference = _difference(identity, other) if isinstance(other, dict) else other
    raise InputError(
        f"{folder} contains a run with other settings ({difference}). Give the settings that it was started with "
        "(.hydra/overrides.yaml), or another folder with paths.output_dir=DIR."
    )


def _newer_settings(folder: Path, identity: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """Return the settings that were introduced after a run began; none if anything else differs."""
    known = {key: value for key, value in identity.items() if key in other}
    return sorted(identity.keys() - other.keys()) if known == other and _is_as_begun(folder, other) else []


def _is_as_begun(folder: Path, other: dict[str, Any]) -> bool:
    """Return whether the run in a folder began with its present config.

    Versions up to 1.0.0 included the budget in a run's identity.
    """
    budget = leaves(read_plain_yaml(folder / ".hydra" / "config.yaml").get("budget"), "budget")
    return read_note(folder).get("fingerprint") in (fingerprint(other), fingerprint(other | budget))


def _former_identity(folder: Path) -> dict[str, Any] | str:
    """Return the identity of the run in a folder, from its original config, or why it is unknown."""
    saved = folder / ".hydra" / "config.yaml"
    if not saved.is_file():
        return "its config was not kept"
    content = read_plain_yaml(saved)
    if not isinstance(content, dict):
        return "its config is damaged"
    try:
        return run_identity(OmegaConf.create(content))
    except OmegaConfBaseException:
        return "its config is damaged"


def _difference(identity: dict[str, Any], other: dict[str, Any]) -> str:
    pairs = {key: (other.get(key, UNKNOWN), identity.get(key, UNKNOWN)) for key in identity.keys() | other.keys()}
    differing = {key: pair for key, pair in pairs.items() if pair[0] != pair[1]}
    keys = sorted(differing, key=lambda key: (key not in other, key))  # settings newer than the run come last
    shown = ", ".join("{}: there {}, here {}".format(key, *differing[key]) for key in keys[:4])
    return shown + (f", and {len(keys) - 4} more" if len(keys) > 4 else "")


def newest_unfinished(root: Path, digest: str, length: tuple[int, float | None], of_job: str | None) -> Path | None:
    """Return the folder of the newest incomplete run with these settings; None if there is none.

    Args:
        root: the folder of all runs.
        digest: fingerprint of the settings.
        length: steps, and seconds of the budget or None.
        of_job: the Slurm job that it must belong to; None: any.
    """
    folders = folders_of_runs(root)
    for folder in sorted(folders, key=lambda folder: (folder / "run.json").stat().st_mtime, reverse=True):
        note = read_note(folder)
        ours = note.get("fingerprint") == digest and (of_job is None or note.get("slurm_job") == of_job)
        if ours and not _is_over(note, *length):
            return folder
    return None


def _is_over(note: Mapping[str, Any], num_steps: int, seconds: float | None) -> bool:
    """Return whether a run has finished and would take no further step with `num_steps` and `seconds`."""
    finished, used = number(note.get("finished_at_step")), number(note.get("budget_seconds"))
    if finished is None:
        return False
    return finished >= num_steps or (seconds is not None and used is not None and used >= seconds)


def former_config(config: DictConfig, job_folder: Path | None) -> Mapping[str, Any] | None:
    """Return the run config that a folder keeps, if the folder is known before the run; None if there is none.

    Nothing in it is built: the folder is untrusted.
    """
    named = required_path("resume", config.resume) if config.resume not in (None, "auto") else None
    path = named or job_folder or config.paths.output_dir
    if path is None:
        return None
    folder = Path(path).parent.parent if Path(path).suffix == ".ckpt" else Path(path)
    try:
        content = read_plain_yaml(folder / ".hydra" / "config.yaml")
    except InputError:
        return None  # resuming it reports the error
    return content if isinstance(content, dict) else None

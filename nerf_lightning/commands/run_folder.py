"""Run folders: chosen before anything is written, held by one process, never shared by two configs.

A run folder has `run.json` (its config's fingerprint, and the step at which it finished), `.hydra/` (config and
overrides), `checkpoints/`, `tensorboard/`, `images/`, and at the end `metrics.json`, `metrics.csv`, `video.mp4`.
"""

import contextlib
import hashlib
import itertools
import json
import os
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.callbacks.checkpoint_file import sweep_leftovers
from nerf_lightning.checkpoints import DAMAGED, LAST, PREVIOUS, newest_checkpoint
from nerf_lightning.commands.suggestions import flatten
from nerf_lightning.errors import InputError
from nerf_lightning.export.atomic import whole_file

# Where a run lies, how long it lasts, what is said of it and what happens after it do not make it another run.
NOT_IDENTITY = (
    *("paths.", "resume", "trainer.max_steps", "trainer.max_epochs", "trainer.val_every_steps"),
    *("logger.", "evaluation.", "final.", "path.", "callbacks.", "viewer.", "scene.cache_dir", "scene.verify"),
)
IDENTITY = ("callbacks.collapse_guard.",)


@dataclass
class RunFolder:
    """A run folder that this process holds."""

    path: Path
    lock: FileLock
    named_checkpoint: Path | None
    """The checkpoint that the user named to go on from."""

    def whole_checkpoint(self) -> Path | None:
        """Return where training goes on: the checkpoint that the user named, else the newest that is whole, if any.

        Raises:
            InputError: there are checkpoints, and none can be read.
        """
        if self.named_checkpoint is not None:
            return self.named_checkpoint
        folder = self.path / "checkpoints"
        found = newest_checkpoint(folder)
        if found is None:
            return None
        if found.path.name == LAST:
            return found.path
        # Else the next save would put the damaged one in the place of the good one.
        with contextlib.suppress(FileNotFoundError):
            os.replace(folder / LAST, folder / DAMAGED)
        os.replace(folder / PREVIOUS, folder / LAST)
        return folder / LAST

    def finish(self, step: int) -> None:
        """Note that the run is complete."""
        note = json.loads((self.path / "run.json").read_text())
        _write_json(self.path / "run.json", note | {"finished_at_step": step})

    def release(self) -> None:
        """Let others have the folder."""
        self.lock.release()


def open_run(config: DictConfig, num_steps: int, job_folder: Path | None) -> RunFolder:
    """Choose the run's folder, refuse it or take hold of it, and write down the config.

    Args:
        config: the run's config.
        num_steps: its length; a run that finished earlier counts as unfinished.
        job_folder: the folder that a sweep gives this job, or None for a single run.

    Raises:
        InputError: the folder is in use, is occupied by another run, or cannot be written.
    """
    identity = run_identity(config)
    folder = _choose(config, identity, num_steps, job_folder)
    try:
        (folder / ".hydra").mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / ".hydra" / "lock")
        lock.acquire(timeout=0)
    except Timeout as error:
        raise InputError(
            f"{folder} is in use by another process that is training there. Wait for it, stop it, or give another "
            "folder with paths.output_dir=DIR."
        ) from error
    except OSError as error:
        raise InputError(
            f"The run folder {folder} cannot be written: {error}. Give another one with paths.output_dir=DIR."
        ) from error
    note = _read_note(folder)
    started = note.get("started") or datetime.now().isoformat(timespec="seconds")
    _write_json(folder / "run.json", {"fingerprint": _digest(identity), "started": started})
    sweep_leftovers(folder / "checkpoints")
    named = str(config.resume).endswith(".ckpt")
    return RunFolder(folder, lock, Path(config.resume) if named else None)


def job_folder() -> Path | None:
    """Return the folder that a sweep gives this job, or None for a single run."""
    hydra_config = HydraConfig.get()
    return Path(hydra_config.runtime.output_dir) if hydra_config.mode == RunMode.MULTIRUN else None


def write_config(folder: Path, config: DictConfig, hydra_config: Any) -> None:
    """Keep the config where Hydra would: `.hydra/config.yaml`, `hydra.yaml` and `overrides.yaml`."""
    kept = {
        "config.yaml": config,
        "hydra.yaml": OmegaConf.masked_copy(hydra_config, ["job", "runtime", "overrides"]),
        "overrides.yaml": OmegaConf.create(list(hydra_config.overrides.task)),
    }
    for name, content in kept.items():
        # Whole or not at all: a resume by the folder's name reads them.
        with whole_file(folder / ".hydra" / name) as part:
            OmegaConf.save(content, part)


def run_identity(config: DictConfig) -> dict[str, Any]:
    """Return the settings that make a run what it is: two of the same identity and length compute the same."""
    leaves = flatten(config)
    return {key: value for key, value in leaves.items() if key.startswith(IDENTITY) or not key.startswith(NOT_IDENTITY)}


def _choose(config: DictConfig, identity: dict[str, Any], num_steps: int, job_folder: Path | None) -> Path:
    resume, given = config.resume, config.paths.output_dir
    if resume is not None and resume != "auto":
        return _to_resume(Path(resume), identity)
    folder = job_folder or (Path(given) if given else None)
    if folder is None and resume == "auto":
        folder = _newest_unfinished(Path(config.paths.root_dir), _digest(identity), num_steps)
    if folder is None:
        return _fresh(Path(config.paths.root_dir) / config.scene.name)
    if (folder / "run.json").exists():
        _refuse_other_run(folder, identity, resuming=resume == "auto")
    return folder


def _to_resume(path: Path, identity: dict[str, Any]) -> Path:
    folder = path.parent.parent if path.suffix == ".ckpt" else path
    if path.suffix == ".ckpt" and not path.is_file():
        raise InputError(f"resume={path}: there is no such checkpoint. A run keeps last.ckpt and best.ckpt.")
    if not (folder / "run.json").is_file():
        raise InputError(
            f"resume={path}: there is no run in {folder} (no run.json). Give a run folder, a checkpoint in one, or "
            "resume=auto for the newest unfinished run of this config."
        )
    _refuse_other_run(folder, identity, resuming=True)
    return folder


def _refuse_other_run(folder: Path, identity: dict[str, Any], resuming: bool) -> None:
    if _read_note(folder).get("fingerprint") == _digest(identity):
        if resuming:
            return
        raise InputError(
            f"{folder} already holds a run of this very config. Add resume=auto to go on with it, or give another "
            "folder with paths.output_dir=DIR."
        )
    raise InputError(
        f"{folder} is occupied by a run of another config ({_difference(folder, identity)}). Give the settings that it "
        "was started with (.hydra/overrides.yaml), or another folder with paths.output_dir=DIR."
    )


def _difference(folder: Path, identity: dict[str, Any]) -> str:
    saved = folder / ".hydra" / "config.yaml"
    if not saved.is_file():
        return "its config was not kept"
    other = run_identity(OmegaConf.load(saved))  # type: ignore[arg-type]
    keys = sorted(key for key in identity.keys() | other.keys() if identity.get(key) != other.get(key))
    shown = ", ".join(f"{key}: there {other.get(key)}, here {identity.get(key)}" for key in keys[:4])
    return shown + (f", and {len(keys) - 4} more" if len(keys) > 4 else "")


def _newest_unfinished(root: Path, digest: str, num_steps: int) -> Path | None:
    notes = sorted(root.rglob("run.json"), key=lambda file: file.stat().st_mtime, reverse=True)
    for file in notes:
        note = _read_note(file.parent)
        if note.get("fingerprint") == digest and note.get("finished_at_step", -1) < num_steps:
            return file.parent
    return None


def _fresh(parent: Path) -> Path:
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    for name in itertools.chain([stamp], (f"{stamp}_{number}" for number in itertools.count(2))):
        with contextlib.suppress(FileExistsError):
            (parent / name).mkdir(parents=True)
            return parent / name
    raise AssertionError("unreachable: the names never end")


def _read_note(folder: Path) -> dict[str, Any]:
    try:
        note = json.loads((folder / "run.json").read_text())
    except (OSError, ValueError):
        return {}
    return note if isinstance(note, dict) else {}


def _digest(identity: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(identity, sort_keys=True, default=str).encode()).hexdigest()[:16]


def _write_json(path: Path, content: dict[str, Any]) -> None:
    with whole_file(path) as part:
        part.write_text(json.dumps(content, indent=2) + "\n")


def beside_checkpoint(checkpoint: Path, name: str) -> Path:
    """Return the folder of this name in the run folder that a checkpoint lies in."""
    beside = checkpoint.absolute().parent
    return (beside.parent if beside.name == "checkpoints" else beside) / name


def output_folder(given: str | None, default: Path) -> Path:
    """Return where a command that does not train writes: as given, else by default.

    The jobs of a sweep have folders of their own.

    Raises:
        InputError: the folder cannot be made or written.
    """
    folder = job_folder() or Path(given or default)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".{os.getpid()}.probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(
            f"The output folder {folder} cannot be written: {error}. Give another one with paths.output_dir=DIR."
        ) from error
    return folder

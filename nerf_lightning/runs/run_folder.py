"""Run folders: chosen before anything is written, held by one process, never shared between two configs.

A run folder contains `run.json` (its config's fingerprint, and its outcome), `.hydra/` (config and overrides),
`checkpoints/`, `tensorboard/`, `images/`, and at the end `metrics.json`, `metrics.csv`, `video.mp4`.
"""

import contextlib
import io
import itertools
import logging
import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.checkpoints.format import DAMAGED, LAST, PREVIOUS
from nerf_lightning.checkpoints.reading import newest_checkpoint, read_checkpoint
from nerf_lightning.compute.slurm import slurm_job, was_requeued
from nerf_lightning.config.instantiate import required_path
from nerf_lightning.config.overrides import key_of
from nerf_lightning.config.setting_rules import fingerprint
from nerf_lightning.files.atomic import persistently, whole_file
from nerf_lightning.files.json_files import number, write_json
from nerf_lightning.files.made_folders import child_of, make_folder, require_no_way_out, require_run
from nerf_lightning.files.regular import open_to_append
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import EscapingFormatter, is_plain
from nerf_lightning.runs.identity import run_identity, settings_digest
from nerf_lightning.runs.resume import newest_unfinished, require_same_run, run_to_resume
from nerf_lightning.runs.summary import read_note

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ResumePoint:
    """Where training resumes, and what must stay unchanged; small enough to be sent between processes."""

    checkpoint: Path
    step: int
    precision: str
    tile_points: int | None
    num_steps: int
    """The planned length of the run; if it was not noted, the steps so far."""


@dataclass
class RunFolder:
    """A run folder that this process holds."""

    path: Path
    lock: FileLock
    named_checkpoint: Path | None
    """The checkpoint that the user named to resume from."""
    began: float = field(default_factory=time.monotonic)

    def resume_point(self) -> ResumePoint | None:
        """Read the checkpoint that the user named, else the newest intact one; None if nothing was saved.

        Raises:
            InputError: there are checkpoints, but none can be read.
        """
        folder, named = self.path / "checkpoints", self.named_checkpoint
        found = newest_checkpoint(folder, True) if named is None else read_checkpoint(named, True)
        if found is None:
            return None
        path = found.path
        if named is None and path.name == PREVIOUS:
            # Otherwise the next save would replace the good one with the damaged one.
            with contextlib.suppress(FileNotFoundError):
                persistently(os.replace, folder / LAST, folder / DAMAGED)
            persistently(os.replace, path, folder / LAST)
            path = folder / LAST
        planned = int(number(read_note(self.path).get("num_steps")) or 0)
        return ResumePoint(path, found.step, found.precision, found.tile_points, max(found.step, planned))

    def trained(self, seconds: float) -> None:
        """Note how long training took since this start, from its first step to its last, and all else until now.

        A resumed run adds to its earlier times.
        """
        note, here = read_note(self.path), time.monotonic() - self.began
        spent = {"training_seconds": seconds, "setup_seconds": here - seconds}
        self.note(**{key: round((number(note.get(key)) or 0.0) + value, 1) for key, value in spent.items()})

    def note(self, **values: Any) -> None:
        """Add values to `run.json`.

        `num_steps` is the planned length, `result` a sentence for the report, `finished_at_step` stands there once the
        run is complete.

        Raises:
            InputError: the folder is gone.
        """
        require_run(self.path)
        note = read_note(self.path)
        now = time.monotonic()
        seconds: float = round((number(note.get("seconds")) or 0.0) + now - self.began, 1)
        self.began = now
        write_json(self.path / "run.json", note | {"seconds": seconds} | values)

    def release(self) -> None:
        """Release the folder to others."""
        self.lock.release()


def open_run(
    config: DictConfig,
    num_steps: int,
    job_folder: Path | None,
    requested: DictConfig | None = None,
    typed: Sequence[str] = (),
) -> RunFolder:
    """Choose the run's folder, refuse or lock it, and write the config.

    Args:
        config: the run's config.
        num_steps: its length; a run that finished with fewer steps counts as unfinished, as does one with a shorter
            budget.
        job_folder: the folder that a sweep gives this job, or None for a single run.
        requested: the config before anything was chosen for the scene; a sweep knows only this of a job in advance.
        typed: the overrides of the command line.

    Raises:
        InputError: the folder is in use, is occupied by another run, or cannot be written.
    """
    identity = run_identity(config)
    for place in (job_folder, config.resume, config.paths.output_dir, config.paths.root_dir):
        if not is_plain(str(place)):
            raise InputError(
                f"The run folder {place} has a name that is not UTF-8 or holds control characters, which TensorBoard "
                "cannot write to. Rename it, or give another folder with paths.output_dir=DIR."
            )
    folder, resuming = _choose(config, identity, num_steps, job_folder)
    if (folder / "run.json").exists():
        require_same_run(folder, identity, set(map(key_of, typed)), resuming)
    require_no_way_out(folder)
    try:
        lock = FileLock(make_folder(folder, ".hydra") / "lock")
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
    note = read_note(folder)
    kept = {"started": datetime.now().isoformat(timespec="seconds"), "seconds": 0.0}
    kept |= {key: note[key] for key in (*kept, "training_seconds", "setup_seconds", "num_steps") if key in note}
    job = {} if slurm_job() is None else {"slurm_job": slurm_job()}
    settings = settings_digest(config if requested is None else requested)
    write_json(folder / "run.json", {"fingerprint": fingerprint(identity), "settings": settings} | kept | job)
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
        # Atomically: a resume by the folder's name reads them.
        with whole_file(folder / ".hydra" / name) as part:
            OmegaConf.save(content, part)


def _choose(config: DictConfig, identity: dict[str, Any], num_steps: int, job_folder: Path | None) -> tuple[Path, bool]:
    """Return the folder, and whether to resume its run."""
    resume, given = config.resume, config.paths.output_dir
    if resume is not None and resume != "auto":
        return run_to_resume(Path(required_path("resume", resume))), True
    folder = job_folder or (Path(given) if given else None)
    if folder is None and (resume == "auto" or was_requeued()):
        of_job = None if resume == "auto" else slurm_job()
        length = num_steps, number(config.budget.seconds)
        folder = newest_unfinished(Path(config.paths.root_dir), fingerprint(identity), length, of_job)
    if folder is None:
        return _fresh(child_of(Path(config.paths.root_dir), str(config.scene.name))), False
    return folder, resume == "auto" or config.sweep.resume or was_requeued() or "preempted" in read_note(folder)


def _fresh(parent: Path) -> Path:
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    for name in itertools.chain([stamp], (f"{stamp}_{count}" for count in itertools.count(2))):
        with contextlib.suppress(FileExistsError):
            return make_folder(parent, name, new=True)
    raise AssertionError("unreachable: the names never end")


@contextlib.contextmanager
def log_file(folder: Path) -> Iterator[None]:
    """Append all log messages to `train.log` in a run folder.

    Raises:
        InputError: something of this name is not a regular file.
        OSError: it cannot be opened.
    """
    with open_to_append(folder / "train.log", "Remove it.") as file:
        # Unbuffered: nothing is left to write at the end, when a full disk would raise another error.
        unbuffered: Any = file.raw
        handler = _Handler(io.TextIOWrapper(unbuffered, "utf-8", write_through=True))
        handler.setFormatter(EscapingFormatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        logging.getLogger().addHandler(handler)
        try:
            yield
        finally:
            logging.getLogger().removeHandler(handler)


class _Handler(logging.StreamHandler):
    def handleError(self, record: logging.LogRecord) -> None:
        """Drop a line that does not fit on the disk: the console shows it, and writers report errors that matter."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handleError(record)

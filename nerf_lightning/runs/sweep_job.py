"""One job of a sweep: skip it if it was done before, run it, and write a record of how it ended.

Jobs may run in other processes and on other machines; they report to the sweep's own process through files in the
sweep's folder. A job that fails returns None, so that the sweep continues with the others.
"""

import logging
import os
import signal
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from nerf_lightning.compute.slurm import was_requeued
from nerf_lightning.config.error_messages import paragraph
from nerf_lightning.files.json_files import number, read_json, write_json
from nerf_lightning.files.made_folders import make_folder, remove_empty
from nerf_lightning.runs.identity import settings_digest
from nerf_lightning.runs.summary import by_key, folders_of_runs, read_note

NUM_JOBS = "NERF_LIGHTNING_JOBS"  # In the environment of the jobs: their number

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class JobRecord:
    """The state of a job."""

    number: int
    overrides: list[str]
    folder: str
    process: int
    state: Literal["running", "finished", "finished before", "failed", "crashed", "stopped"] = "running"
    reason: str = ""

    def write(self, sweep_folder: Path) -> None:
        """Write the record for the sweep's own process."""
        write_json(make_folder(records_folder(sweep_folder)) / f"{self.number}.json", asdict(self))


def run_job(run: Callable[[DictConfig], Any], config: DictConfig, command: str) -> Any:
    """Run one job of a sweep (a command with its config) and return its value; None if it failed.

    Raises:
        SystemExit: a signal stopped the job, which stops a sweep whose jobs run in one process.
    """
    hydra = HydraConfig.get()
    sweep_folder, own = Path(hydra.sweep.dir), Path(hydra.runtime.output_dir)
    elsewhere = not hydra.launcher._target_.endswith(".BasicLauncher")
    if elsewhere:
        # Imported late: rich is slow to import, and this file is read before any command.
        from nerf_lightning.messages.console import label_lines

        # The sweep's own process receives Ctrl-C and passes it on to the running jobs.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        # Bars of several processes on one terminal overwrite each other; rich reads this variable.
        os.environ["TTY_COMPATIBLE"] = "0"
        label_lines(job_label(int(hydra.job.num), own, list(hydra.overrides.task)))
        if stop_file(sweep_folder).exists():
            return None
    record = JobRecord(int(hydra.job.num), list(hydra.overrides.task), str(own), os.getpid())
    record.write(sweep_folder)
    try:
        former = _former_run(sweep_folder, own, config)
        if former is not None:
            return _skip(record, former, sweep_folder)
        value = run(config)
    except Exception as error:
        _failed(record, error, paragraph(error, command)).write(sweep_folder)
        remove_empty(own)
        return None
    except (SystemExit, KeyboardInterrupt) as stop:
        if 0 < (getattr(stop, "code", None) or 0) < 128:  # of processes that the job started
            replace(record, state="failed", reason="see its messages above").write(sweep_folder)
            return None
        replace(record, state="stopped").write(sweep_folder)
        # joblib would kill the other jobs before they have saved.
        if elsewhere and stop_file(sweep_folder).exists():
            return None
        raise
    replace(record, state="finished").write(sweep_folder)
    return value


def _skip(record: JobRecord, run_folder: Path, sweep_folder: Path) -> float | None:
    log.info("job %d has finished before: %s", record.number, run_folder)
    own = Path(record.folder)
    if run_folder != own:
        remove_empty(own)
    replace(record, folder=str(run_folder), state="finished before").write(sweep_folder)
    return number(read_note(run_folder).get("psnr"))


def job_label(number: int, folder: Path, overrides: list[str]) -> str:
    """Return what distinguishes a job from parallel ones: its number, and the settings in its folder's name.

    >>> job_label(2, Path("2_optimizer.lr=0.01"), ["model=fast", "optimizer.lr=0.01"])
    '[3 lr=0.01]'
    """
    given = by_key(overrides).items()
    swept = [f"{key.rpartition('.')[2]}={value}" for key, value in given if f"_{key}=" in folder.name]
    total = os.environ.get(NUM_JOBS)
    return f"[{' '.join([str(number + 1) + (f'/{total}' if total else ''), *swept])}]"


def _failed(record: JobRecord, error: Exception, reason: str | None) -> JobRecord:
    if reason is None:
        log.exception("job %s crashed", Path(record.folder).name)
        return replace(record, state="crashed", reason=f"{type(error).__name__}: {error}".splitlines()[0])
    log.error("job %s failed: %s", Path(record.folder).name, reason)
    return replace(record, state="failed", reason=reason)


def read_records(sweep_folder: Path) -> list[JobRecord]:
    """Return the records of a sweep's jobs, in order."""
    # Skip names that begin with a dot: a job may be writing its record, or was killed while it did.
    files = records_folder(sweep_folder).glob("[!.]*.json")
    records = [JobRecord(**read_json(file)) for file in files]
    return sorted(records, key=lambda record: record.number)


def records_folder(sweep_folder: Path) -> Path:
    """Return the folder of the jobs' records."""
    return sweep_folder / ".hydra" / "jobs"


def stop_file(sweep_folder: Path) -> Path:
    """Return the file that keeps waiting jobs from starting, and makes training jobs save and stop."""
    return sweep_folder / ".hydra" / "stop"


def _former_run(sweep_folder: Path, own: Path, config: DictConfig) -> Path | None:
    if "sweep" not in config or not (config.sweep.resume or was_requeued()):
        return None
    others = sorted(folder for folder in folders_of_runs(sweep_folder) if folder != own)
    return finished_run([own, *others], config)


def finished_run(folders: Iterable[Path], config: DictConfig) -> Path | None:
    """Return the first folder whose run did everything in this config, or None."""
    digest = settings_digest(config)
    for folder in folders:
        note = read_note(folder)
        if note.get("settings") == digest and "finished_at_step" in note:
            return folder
    return None

"""A sweep in its own process: the command to resume it, the jobs' cores, Ctrl-C, and the table at its end.

The name of its folder: `conf/hydra/nerf.yaml`.
"""

import logging
import math
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import psutil
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.compute.cores import num_cores
from nerf_lightning.compute.slurm import slurm_job
from nerf_lightning.config.overrides import to_type
from nerf_lightning.files.made_folders import remove_empty
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import for_terminal
from nerf_lightning.messages.exit_codes import OF_SIGNALS
from nerf_lightning.runs.saved_overrides import to_give_again
from nerf_lightning.runs.summary import RunSummary, by_key, differing_keys, read_run, told_settings
from nerf_lightning.runs.sweep_job import NUM_JOBS, JobRecord, read_records, records_folder, stop_file
from nerf_lightning.runs.sweep_record import SweepRecord, sweep_record

log = logging.getLogger(__name__)

# Launchers whose jobs are processes of this machine; jobs of the others continue when this process is stopped.
LOCAL_LAUNCHERS = (".JoblibLauncher", ".LocalLauncher")


@dataclass
class Sweep:
    """A running sweep."""

    command: str
    folder: Path
    record: SweepRecord
    received: int | None = None
    """The signal that stopped it."""
    made: list[Path] = field(default_factory=list)
    """Its folder and parents that it newly made, the innermost first."""
    former_handlers: dict[int, Any] = field(default_factory=dict)

    def go_on_with(self) -> str:
        """Return the command that resumes it."""
        folder = to_type("paths.output_dir", str(self.folder))
        again = to_give_again(self.record.typed(), of_sweep=True)
        return " ".join([self.command, "-m sweep.resume=true", folder, *again])


# Hydra builds its callbacks itself, so their state must be kept outside.
_begun: list[Sweep] = []


class SweepWatch(Callback):
    """Hydra's notification that a sweep begins, in the process that the user started."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Record the arguments, log how to resume after a stop, and distribute the cores."""
        asked: Any = OmegaConf.to_container(config.hydra.overrides, resolve=False)
        record = SweepRecord([*asked["hydra"], *asked["task"]], slurm_job())
        sweep = Sweep(sys.argv[0], Path(config.hydra.sweep.dir), record)
        sweep.made = [each for each in (sweep.folder, *sweep.folder.parents) if not each.exists()]
        for leftover in (*records_folder(sweep.folder).glob("*.json"), stop_file(sweep.folder)):
            leftover.unlink(missing_ok=True)
        record.write(sweep.folder)
        if "sweep" in config:
            said = f"sweep folder {sweep.folder}; if it stops, resume with: {sweep.go_on_with()}"
            print(for_terminal(said), file=sys.stderr)
        # Optuna's database library logs its parts.
        logging.getLogger("alembic").setLevel(logging.WARNING)
        os.environ[NUM_JOBS] = _num_jobs(config.hydra)
        launcher = config.hydra.launcher._target_
        if launcher.endswith(LOCAL_LAUNCHERS):
            _share_cores(launcher, config.hydra.launcher)
            _pass_signals_on(sweep)
        _begun.append(sweep)


def watched(run: Callable[[], None]) -> None:
    """Run a sweep, and report its jobs' outcomes at its end, however it ends.

    Raises:
        InputError: some jobs failed.
        SystemExit: it was stopped by a signal, or a job crashed.
    """
    _begun.clear()
    error: Exception | None = None
    try:
        run()
    except Exception as raised:
        error = raised
    finally:
        records = _end() if _begun else []
    bad = [record for record in records if record.state not in ("finished", "finished before")]
    if error is not None and (not bad or isinstance(error, InputError)):
        raise error
    if _begun and _begun[-1].received is not None:
        raise SystemExit(OF_SIGNALS + _begun[-1].received)
    if bad:
        _complain(bad, len(records), error)


def _end() -> list[JobRecord]:
    # Imported late: they import torch, and Hydra loads this module before it composes any command's config.
    from nerf_lightning.messages.console import say
    from nerf_lightning.runs.table_files import write_csv, write_markdown
    from nerf_lightning.runs.table_screen import print_rows

    sweep = _begun[-1]
    for number, handler in sweep.former_handlers.items():
        signal.signal(number, handler)
    records = read_records(sweep.folder)
    if not records:
        return []
    if all(record.state == "failed" for record in records) and _remove_refused(sweep):
        return records
    rows = job_rows(records, sweep.folder)
    print_rows(rows, f"sweep {sweep.folder}", "The files below hold all of it.")
    write_csv(rows, sweep.folder / "sweep.csv")
    write_markdown(rows, sweep.folder / "sweep.md")
    say(f"table        {sweep.folder / 'sweep.md'}, sweep.csv")
    if any(record.state in ("running", "stopped") for record in records):
        say(f"resume with  {sweep.go_on_with()}")
    return records


def _remove_refused(sweep: Sweep) -> bool:
    """Remove what a sweep made if none of its jobs has begun; return whether there was nothing else."""
    folder = sweep.folder
    if any(path.name not in (".hydra", "multirun.yaml") for path in folder.iterdir()):
        return False
    for left in (*records_folder(folder).glob("*.json"), sweep_record(folder), folder / "multirun.yaml"):
        left.unlink(missing_ok=True)
    remove_empty(records_folder(folder), folder / ".hydra", *sweep.made)
    return True


def _num_jobs(hydra: DictConfig) -> str:
    """Return how many jobs there will be; empty if the sweeper decides as it goes."""
    if not hydra.sweeper._target_.endswith(".BasicSweeper"):
        return str(hydra.sweeper.get("n_trials") or "")
    parsed = OverridesParser.create().parse_overrides(list(hydra.overrides.task))
    swept = (sum(1 for _ in each.sweep_string_iterator()) for each in parsed if each.is_sweep_override())
    return str(math.prod(swept))


def _complain(bad: list[JobRecord], total: int, error: Exception | None) -> None:
    reasons: dict[str, list[str]] = {}
    for record in bad:
        reasons.setdefault(record.reason or f"its process ended ({error})", []).append(Path(record.folder).name)
    told = " ".join(f"{', '.join(names)}: {reason}" for reason, names in reasons.items())
    message = f"{len(bad)} of {total} jobs failed. {told}"
    if all(record.state == "failed" for record in bad):
        raise InputError(message)
    log.error("nerf: %s", message)
    raise SystemExit(1)


def _share_cores(launcher: str, settings: DictConfig) -> None:
    # joblib divides them by its number of jobs and sets OMP_NUM_THREADS for each; submitit's local jobs get no limit.
    os.environ.setdefault("LOKY_MAX_CPU_COUNT", str(num_cores()))
    if launcher.endswith(".LocalLauncher"):
        os.environ.setdefault("OMP_NUM_THREADS", str(settings.cpus_per_task or 1))


def _pass_signals_on(sweep: Sweep) -> None:
    def pass_on(number: int, frame: FrameType | None) -> None:
        if sweep.received is not None:
            raise KeyboardInterrupt
        sweep.received = number
        stop_file(sweep.folder).touch()
        log.info("stopping: running jobs finish their step and save")
        # Training jobs see the file. A signal also stops the others, but on Windows it would not let them save.
        for record in read_records(sweep.folder) if os.name == "posix" else ():
            if record.state == "running" and psutil.pid_exists(record.process):
                os.kill(record.process, signal.SIGTERM)

    for number in (signal.SIGINT, signal.SIGTERM):
        sweep.former_handlers[number] = signal.signal(number, pass_on)


def job_rows(records: list[JobRecord], sweep_folder: Path) -> list[dict[str, Any]]:
    """Return a row per job, sorted by PSNR; settings that are the same for all jobs are left out."""
    runs = {record.number: read_run(Path(record.folder)) for record in records}
    settings = {record.number: told_settings(by_key(record.overrides)) for record in records}
    swept = differing_keys(list(settings.values()))
    rows = []
    for record in sorted(records, key=lambda record: _rank(runs[record.number], record)):
        run = runs[record.number]
        row: dict[str, Any] = {"job": record.number} | {key: settings[record.number].get(key, "") for key in swept}
        results = {"PSNR": run.psnr, "SSIM": run.ssim, "steps": run.steps, "seconds": run.seconds}
        row |= results if "finished" in record.state else dict.fromkeys(results)
        folder, whole = run.folder.absolute(), sweep_folder.absolute()
        shown = str(folder.relative_to(whole) if folder.is_relative_to(whole) else run.folder)
        rows.append(row | {"state": record.state, "folder": shown})
    return rows


def _rank(run: RunSummary, record: JobRecord) -> tuple[bool, float, int]:
    known = run.psnr is not None and "finished" in record.state
    return not known, -(run.psnr or 0.0) if known else 0.0, record.number

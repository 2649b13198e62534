"""The folder of a run: taken by one process for all, held during training, and marked with how the run ended."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from lightning.pytorch.loggers import Logger
from omegaconf import DictConfig

from nerf_lightning.commands.train_job.build import TrainJob
from nerf_lightning.compute import ranks
from nerf_lightning.files.atomic import full_disk_named
from nerf_lightning.files.made_folders import require_run
from nerf_lightning.messages.errors import InputError
from nerf_lightning.runs.run_folder import ResumePoint, RunFolder, job_folder, log_file, open_run, write_config
from nerf_lightning.runs.summary import read_note
from nerf_lightning.training.callbacks.watcher import errors_told_once
from nerf_lightning.training.launch.preemption import wants_restart
from nerf_lightning.training.loggers import opened_loggers


@dataclass
class HeldFolder:
    """The run's folder as every process sees it; only the first one holds it, and writes how the run ended."""

    path: Path
    resume_point: ResumePoint | None
    """Where training resumes; None: from the beginning."""
    held: RunFolder | None
    loggers: list[Logger]

    def note(self, **values: Any) -> None:
        """Add values to `run.json`."""
        if self.held is not None:
            self.held.note(**values)

    def trained(self, seconds: float) -> None:
        """Note how long training took since this start."""
        if self.held is not None:
            self.held.trained(seconds)


@contextmanager
def held_folder(job: TrainJob, requested: DictConfig) -> Iterator[HeldFolder]:
    """Take the folder of a job, and open its log and loggers; note how the run ended, and release the folder.

    `requested` is the config before anything was chosen for the scene.
    """
    held: list[RunFolder] = []

    def take() -> tuple[Path, ResumePoint | None]:
        hydra = HydraConfig.get()
        held.append(open_run(job.config, job.num_steps, job_folder(), requested, hydra.overrides.task))
        write_config(held[0].path, job.config, hydra)
        return held[0].path, held[0].resume_point()

    try:
        path, resume_point = ranks.from_first(take)
        with (
            errors_told_once(),
            full_disk_named(path),
            log_file(path) if ranks.is_first() else nullcontext(),
            _loggers(job, path, resume_point) as loggers,
        ):
            yield HeldFolder(path, resume_point, held[0] if held else None, loggers)
    except SystemExit as stop:
        for folder in held:
            folder.trained(job.clock.seconds)
            folder.note(**({"preempted": True} if wants_restart(stop.code) else {}))  # then it is started again
        raise
    except (InputError, OSError):
        for folder in held:
            require_run(folder.path)  # if it is gone, that is why anything failed
        raise
    finally:
        for folder in held:
            folder.release()


@contextmanager
def _loggers(job: TrainJob, folder: Path, resume_point: ResumePoint | None) -> Iterator[list[Logger]]:
    purge: dict[str, int] = {}
    if (folder / "tensorboard").exists():
        # Steps logged after the checkpoint will be logged again: tell TensorBoard to purge them.
        purge = {"purge_step": 0 if resume_point is None else resume_point.step + 1}
    started = str(read_note(folder).get("started"))
    with opened_loggers(job.loggers if ranks.is_first() else {}, folder, started, **purge) as loggers:
        yield loggers

"""What a person gets to see of a training: Lightning's profile, the page of the scene, the report of the run."""

import logging
from pathlib import Path

from lightning.pytorch import Trainer

from nerf_lightning.commands.train_job.build import TrainJob
from nerf_lightning.commands.train_job.final_page import write_final_page
from nerf_lightning.commands.train_job.profile_table import profile_lines
from nerf_lightning.compute import ranks
from nerf_lightning.messages.console import say
from nerf_lightning.report.page import write_page
from nerf_lightning.report.read_run import read_run
from nerf_lightning.runs.results import FILES
from nerf_lightning.training.launch.lightning_flags import PROFILE

MOST_VIDEO_BYTES = 20_000_000
"""Of a film in the page that follows a training."""

log = logging.getLogger(__name__)


def show(job: TrainJob, folder: Path, trainer: Trainer) -> None:
    """Close the loggers, and write what the config asks for."""
    for logger in trainer.loggers:
        logger.finalize("success")
    if not ranks.is_first():
        return
    lines = profile_lines(trainer)
    if lines:
        say(*lines)
    for profile in sorted(folder.glob(f"fit-{PROFILE}*.txt")):
        log.info("profile: %s", profile)
    if job.post_training.page is not None:
        write_final_page(job.post_training.page, job, folder)
    if job.config.final.report:
        checks, target = job.checks, folder / "report.html"
        examine = None if checks is None else lambda: checks
        write_page(read_run(folder, folder / FILES["run"], MOST_VIDEO_BYTES, examine), target)
        say(f"report       {target}")

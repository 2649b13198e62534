"""What a person gets to see of a training: Lightning's profile, the page of the scene, the report of the run."""

import logging
from pathlib import Path

from lightning.pytorch import Trainer

from nerf_lightning.commands.train_job.build import TrainJob
from nerf_lightning.commands.train_job.final_page import write_final_page
from nerf_lightning.commands.train_job.profile_table import profile_lines
from nerf_lightning.compute import ranks
from nerf_lightning.doctor.examine import advice
from nerf_lightning.messages.console import say
from nerf_lightning.report.page import write_page
from nerf_lightning.report.read_run import read_run
from nerf_lightning.runs.results import FILES
from nerf_lightning.training.launch.lightning_flags import PROFILE

MOST_VIDEO_BYTES = 20_000_000
"""Of a film in the page that follows a training."""

log = logging.getLogger(__name__)


def show(job: TrainJob, folder: Path, trainer: Trainer, psnr: float | None) -> None:
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
        say(f"report       {target}", *_result(job, psnr))


def _result(job: TrainJob, psnr: float | None) -> list[str]:
    """Return what came out of the photographs, and what would improve it most."""
    used = len(job.scene.view_names)
    quality = "" if psnr is None else f"{psnr:.1f} dB on photographs held out, "
    lines = [f"result       {quality}{used} of {used + len(job.scene.left_out)} photographs used"]
    cure = advice(job.checks or ())
    return lines if cure is None else [*lines, f"to improve   {cure}"]

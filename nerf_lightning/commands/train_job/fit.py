"""Fit a job's system: choose precision and tile, announce the run, and let Lightning's Trainer take the steps.

The lines before training, and those of a run that is stopped, are here; those after it in `show.py`.
"""

import logging
import shlex
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from lightning.pytorch import Trainer
from omegaconf import OmegaConf

from nerf_lightning.checkpoints.trusted_classes import modules_to_trust
from nerf_lightning.commands.train_job.build import TrainJob, searchpath_override
from nerf_lightning.commands.train_job.held_folder import HeldFolder
from nerf_lightning.commands.train_job.memory_plan import announce_memory
from nerf_lightning.compute import ranks
from nerf_lightning.config.auto_settings import CPU_SECONDS
from nerf_lightning.config.overrides import to_type
from nerf_lightning.messages.console import spoken
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.exit_codes import OF_SIGNALS
from nerf_lightning.nerf.models.tiles import is_device_failure
from nerf_lightning.runs.saved_overrides import to_give_again
from nerf_lightning.training.callbacks.hparams import describe_run
from nerf_lightning.training.fastest_tile import SHORT_RUN, measured_tile

LONG = 3600.0
"""Seconds of training beyond which a shorter alternative is suggested before it starts."""

log = logging.getLogger(__name__)


def fit(job: TrainJob, folder: HeldFolder) -> Trainer:
    """Train from the beginning, or from where the run in the folder stopped, and return the trainer.

    Raises:
        SystemExit: a signal stopped the training, which was saved (128 + signal).
        InputError: the GPU has failed.
    """
    resume_point = folder.resume_point
    _keep_end(job, folder)
    _prepare(job, folder)
    trainer = job.settings.build(folder.path, job.num_steps, job.callbacks, folder.loggers)
    _announce(job, folder)
    if resume_point is None:
        describe_run(trainer.loggers, job.config)
    checkpoint = None if resume_point is None else resume_point.checkpoint
    try:
        trainer.fit(job.system, job.data, ckpt_path=checkpoint, weights_only=True)
    except RuntimeError as error:
        if not is_device_failure(error):
            raise
        trainer.strategy.checkpoint_io.teardown()  # waits for pending writes, of which the host has a copy
        raise InputError(
            f"The GPU has failed after step {trainer.global_step}: {' '.join(str(error).split())[:200]}. "
            f"{_what_is_left(folder)} If it fails again, nerf selftest checks the GPU's results, and trainer=cpu does "
            "not use it."
        ) from error
    if ranks.is_first():
        steps = trainer.global_step - (0 if resume_point is None else resume_point.step)
        log.info("%d step%s in %s", steps, "s" * (steps != 1), spoken(job.clock.seconds))
    if job.signals.received is not None:
        log.info("stopped at step %d; resume with: %s", trainer.global_step, resume_command(folder.path))
        raise SystemExit(OF_SIGNALS + job.signals.received)
    return trainer


def _what_is_left(folder: HeldFolder) -> str:
    if not any((folder.path / "checkpoints").glob("*.ckpt")):
        return "Nothing was saved yet: start again."
    return f"Resume from the last checkpoint with: {resume_command(folder.path)}."


def _keep_end(job: TrainJob, folder: HeldFolder) -> None:
    """Make a resumed run at least as long as originally planned: its learning rate follows that length."""
    resume_point = folder.resume_point
    if resume_point is not None and job.num_steps < resume_point.num_steps:
        log.warning(
            "This run was planned for %d steps, and its learning rate follows that length: it continues to step %d, "
            "not %d. For a shorter run, start a new one.",
            resume_point.num_steps,
            resume_point.num_steps,
            job.num_steps,
        )
        job.num_steps = resume_point.num_steps
    if job.config.budget.seconds is None:  # else the time ends it, and its learning rate follows that
        folder.note(num_steps=job.num_steps)


def _prepare(job: TrainJob, folder: HeldFolder) -> None:
    """Move the model to its device, with the precision and tile that suit it, or that the run began with."""
    train_step, settings, resume_point = job.system.train_step, job.settings, folder.resume_point
    if resume_point is not None:
        log.info("resuming from step %d of %s", resume_point.step, folder.path)
        settings.keep_precision(resume_point.precision)
        settings.keep_tile(resume_point.tile_points)
        train_step.tiles.points = settings.tile_points
    settings.prepare(train_step.objective.model)
    job.system.record["precision"] = settings.precision
    # CUDA graphs record whole batches.
    measures_tile = settings.measures_tile and job.num_steps > SHORT_RUN and not settings.records(train_step)
    if resume_point is None and measures_tile:
        tile, seconds = ranks.from_first(lambda: measured_tile(settings, train_step, job.data.batches))
        train_step.tiles.points = settings.tile_points = tile
        if seconds is not None:
            _announce_hours(job, seconds)
    if ranks.is_first():
        announce_memory(settings, train_step, job.data)
    if settings.compile:
        compiled = train_step.objective.model.compile_fields()
        log.info("compiled levels: %s", ", ".join(compiled) or "none has static shapes")


def _announce_hours(job: TrainJob, seconds: float) -> None:
    """Log how long the steps of the run, or of its model's publication, will take, if that is hours.

    Args:
        job: the job to train.
        seconds: approximate time per step.
    """
    budget = job.config.budget.seconds
    steps, which = (job.num_steps, "") if budget is None else (job.settings.published_steps, ", as published,")
    if steps * seconds < LONG or not ranks.is_first():
        return
    brief = budget or CPU_SECONDS
    log.info(
        "time: %s steps%s take about %s here (trainer.max_steps=%d); %s are about %s steps (budget.seconds=%g)",
        *(f"{steps:,}", which, spoken(steps * seconds), steps),
        *(spoken(brief), f"{max(1, int(brief / seconds)):,}", brief),
    )


def _announce(job: TrainJob, folder: HeldFolder) -> None:
    parameters = sum(parameter.numel() for parameter in job.system.model.parameters())
    tile = job.system.train_step.tiles.points
    how = "whole batches" if tile is None else f"tiles of {tile:,} points"
    seconds = job.config.budget.seconds
    log.info("run folder %s", folder.path)
    log.info(
        "training: %s, %s rays per step, %s parameters, %s, %s",
        f"{job.num_steps:,} step{'s' * (job.num_steps != 1)}"
        if seconds is None
        else f"{spoken(seconds)} (budget.seconds)",
        f"{job.data.batches.batch_rays:,}",
        f"{parameters:,}",
        job.settings.describe(),
        "steps replayed" if job.settings.records(job.system.train_step) else how,
    )
    if folder.resume_point is None and job.config.resume == "auto":
        log.info("resume=auto: there is no unfinished run with these settings to resume; starting a new run")
    trust = trust_setting(job)
    if trust:
        log.info("the model has parts of your own: commands that open its checkpoints need %s", trust)


def trust_setting(job: TrainJob) -> str:
    """Return the setting that commands need to open the run's checkpoints; empty if none."""
    own = modules_to_trust(OmegaConf.to_container(job.config.model, resolve=True))
    return f"trust={own[0] if len(own) == 1 else '[' + ','.join(own) + ']'}" if own else ""


def resume_command(folder: Path) -> str:
    """Return the command that resumes a run."""
    return " ".join(["nerf train", to_type("resume", str(folder)), *resume_settings()])


def resume_settings() -> list[str]:
    """Return the settings that resuming needs again, besides the folder, as typed in a shell."""
    return [*map(shlex.quote, searchpath_override()), *to_give_again(HydraConfig.get().overrides.task)]

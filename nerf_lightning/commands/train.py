"""Learn a radiance field from photographs with known cameras."""

import logging
import shlex
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from lightning.pytorch import Trainer
from lightning.pytorch.loggers import Logger
from omegaconf import DictConfig, OmegaConf

from nerf_lightning import ranks
from nerf_lightning.checkpoints.trusted_classes import modules_to_trust
from nerf_lightning.commands.final_page import write_final_page
from nerf_lightning.config.overrides import to_type
from nerf_lightning.config.tree import print_tree
from nerf_lightning.console import StdoutConsole, say, spoken
from nerf_lightning.errors import InputError
from nerf_lightning.files.atomic import full_disk_named
from nerf_lightning.report.page import write_page
from nerf_lightning.report.read_run import read_run
from nerf_lightning.runs.folder import ResumePoint, RunFolder, former_config, job_folder, open_run, write_config
from nerf_lightning.runs.log_file import log_file
from nerf_lightning.runs.results import FILES
from nerf_lightning.runs.saved_overrides import to_give_again
from nerf_lightning.runs.summary import read_note
from nerf_lightning.training.build import Parts, build_parts
from nerf_lightning.training.callbacks.folder_guard import require_run
from nerf_lightning.training.callbacks.hparams import describe_run
from nerf_lightning.training.callbacks.watcher import errors_told_once
from nerf_lightning.training.launch.lightning_flags import PROFILE
from nerf_lightning.training.launch.preemption import preemptible, wants_restart
from nerf_lightning.training.launch.processes import on_all_processes
from nerf_lightning.training.loggers import opened_loggers
from nerf_lightning.training.memory_plan import announce_memory
from nerf_lightning.training.profile_table import profile_lines
from nerf_lightning.training.tile_size import SHORT_RUN, measured_tile

MOST_VIDEO_BYTES = 20_000_000
"""Of a film in the page that follows a training."""

log = logging.getLogger(__name__)


def run(config: DictConfig) -> float | None:
    """Train, and return the test PSNR (the validation's where no evaluation follows), which sweepers may maximise."""
    with preemptible():
        return on_all_processes("train", config, lambda config: train(config).psnr)


@dataclass(frozen=True)
class Trained:
    """What a training came to."""

    folder: Path
    psnr: float | None
    """dB; of the test views, or the validation's where no evaluation follows."""


def train(config: DictConfig) -> Trained:
    """Train as the config says, in this process or as one of several.

    Raises:
        SystemExit: a signal stopped the run (128 + signal), so that a sweep stops too.
    """
    # Whatever is wrong with the input shows here, before a folder is taken.
    hydra = HydraConfig.get()
    known = ranks.from_first(lambda: former_config(config, job_folder()))
    # What is left open is composed again, and may lie where the command line has said.
    parts = build_parts(config, hydra.runtime.choices, [*_searched(), *hydra.overrides.task], known)
    asked, config = config, parts.config
    if config.print_config and ranks.is_first():
        print_tree(config, StdoutConsole())
    held: list[RunFolder] = []
    try:
        path, former = ranks.from_first(lambda: _take_folder(config, asked, parts.num_steps, held))
        with (
            errors_told_once(),
            full_disk_named(path),
            log_file(path) if ranks.is_first() else nullcontext(),
            _loggers(parts, path, former) as loggers,
        ):
            trainer = _fit(parts, path, former, loggers)
            for folder in held:
                folder.trained(parts.clock.seconds)
            psnr, last_step = _finish(parts, path, trainer), trainer.global_step
        for folder in held:
            folder.finish(last_step, psnr)
        return Trained(path, psnr)
    except SystemExit as stop:
        for folder in held:
            folder.trained(parts.clock.seconds)
            folder.stop(restarted=wants_restart(stop.code))
        raise
    except (InputError, OSError):
        for folder in held:
            require_run(folder.path)  # where it is gone, whatever failed has failed for that
        raise
    finally:
        for folder in held:
            folder.release()


def _take_folder(
    config: DictConfig, asked: DictConfig, num_steps: int, held: list[RunFolder]
) -> tuple[Path, ResumePoint | None]:
    """Let one process choose and hold the folder for all; return it, and where training goes on."""
    hydra_config = HydraConfig.get()
    folder = open_run(config, num_steps, job_folder(), asked, hydra_config.overrides.task)
    held.append(folder)
    write_config(folder.path, config, hydra_config)
    return folder.path, folder.resume_point()


def _fit(parts: Parts, folder: Path, former: ResumePoint | None, loggers: list[Logger]) -> Trainer:
    step = parts.system.step
    if former is not None:
        log.info("going on from step %d of %s", former.step, folder)
        parts.settings.keep_precision(former.precision)
        parts.settings.keep_tile(former.tile_points)
        step.tile_points = parts.settings.tile_points
    parts.settings.prepare(parts.system.model)
    parts.system.record["precision"] = parts.settings.precision
    measures_tile = parts.settings.measures_tile and parts.num_steps > SHORT_RUN
    if former is None and measures_tile and not parts.system.model.needs_whole_batch:
        tile = ranks.from_first(lambda: measured_tile(parts.settings, step, parts.data.batches))
        step.tile_points = parts.settings.tile_points = tile
    if ranks.is_first():
        announce_memory(parts.settings, step, parts.data)
    if parts.settings.compile:
        log.info("compiled levels: %s", ", ".join(parts.system.model.compile_fields()) or "none has static shapes")
    if parts.settings.cuda_graph:
        step.record_gradients()
    trainer = parts.settings.build(folder, parts.num_steps, parts.callbacks, loggers)
    _announce(parts, folder, former)
    if former is None and parts.config.resume == "auto":
        log.info("resume=auto: there is no unfinished run of this config to go on with; this one begins anew")
    if former is None:
        describe_run(trainer.loggers, parts.config)
    checkpoint = None if former is None else former.checkpoint
    trainer.fit(parts.system, parts.data, ckpt_path=checkpoint, weights_only=True)
    if ranks.is_first():
        steps = trainer.global_step - (0 if former is None else former.step)
        log.info("%d steps in %s", steps, spoken(parts.clock.seconds))
    _show_profile(trainer, folder)
    if parts.signals.received is not None:
        log.info("stopped at step %d; go on with: %s", trainer.global_step, _resume_command(folder))
        raise SystemExit(128 + parts.signals.received)
    return trainer


def _show_profile(trainer: Trainer, folder: Path) -> None:
    lines = profile_lines(trainer) if ranks.is_first() else []
    if lines:
        say(*lines)
    for profile in sorted(folder.glob(f"fit-{PROFILE}*.txt")):
        log.info("profile: %s", profile)


def _finish(parts: Parts, folder: Path, trainer: Trainer) -> float | None:
    psnr = parts.finish(parts.settings, parts.scene, parts.system.model, trainer, folder)
    for logger in trainer.loggers:
        logger.finalize("success")
    if parts.finish.page is not None and ranks.is_first():
        write_final_page(parts.finish.page, parts, folder)
    if parts.config.final.report and ranks.is_first():
        _write_report(parts, folder)
    return psnr


def _write_report(parts: Parts, folder: Path) -> None:
    checks, target = parts.checks, folder / "report.html"
    examine = None if checks is None else lambda: checks
    write_page(read_run(folder, folder / FILES["run"], MOST_VIDEO_BYTES, examine), target)
    say(f"report       {target}")


def _announce(parts: Parts, folder: Path, former: ResumePoint | None) -> None:
    parameters = sum(parameter.numel() for parameter in parts.system.model.parameters())
    tile = parts.system.step.tile_points
    seconds = parts.config.budget.seconds
    log.info(
        "run folder %s: %s of %d rays, %s parameters, %s, %s",
        folder,
        f"{parts.num_steps} steps" if seconds is None else f"{spoken(seconds)} (budget.seconds) of steps",
        parts.data.batches.batch_rays,
        f"{parameters:,}",
        parts.settings.describe(),
        "whole batches" if tile is None else f"tiles of {tile} points",
    )
    own = modules_to_trust(OmegaConf.to_container(parts.config.model, resolve=True))
    if own:
        log.info(
            "the model has parts of your own: a command that opens its checkpoints builds them only with trust=%s",
            own[0] if len(own) == 1 else f"[{','.join(own)}]",
        )


@contextmanager
def _loggers(parts: Parts, folder: Path, former: ResumePoint | None) -> Iterator[list[Logger]]:
    purge: dict[str, int] = {}
    if (folder / "tensorboard").exists():
        # Steps that were logged after the checkpoint will be logged again: TensorBoard is told to forget them.
        purge = {"purge_step": 0 if former is None else former.step + 1}
    started = str(read_note(folder).get("started"))
    with opened_loggers(parts.loggers if ranks.is_first() else {}, folder, started, **purge) as loggers:
        yield loggers


def _resume_command(folder: Path) -> str:
    again = to_give_again(HydraConfig.get().overrides.task)
    return " ".join(["nerf train", to_type("resume", str(folder)), *map(shlex.quote, _searched()), *again])


def _searched() -> list[str]:
    """Return the override that names folders with yamls of a person's own, if there is one."""
    return [each for each in HydraConfig.get().overrides.hydra if each.startswith("hydra.searchpath=")]

"""The last lines of a run: Lightning's profile, exports of the scene, the report, and the result in a sentence.

The lines on video and checkpoint: `evaluate_and_film.py`; those of the metrics: `evaluation/main_numbers.py`;
those before training: `fit.py`.
"""

import logging
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from statistics import fmean

from lightning.pytorch import Trainer
from lightning.pytorch.profilers import SimpleProfiler
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.checkpoints.trusted_classes import modules_to_trust
from nerf_lightning.commands.export import write_files
from nerf_lightning.commands.train_job.build import TrainJob
from nerf_lightning.commands.train_job.fit import resume_command, resume_settings, trust_setting
from nerf_lightning.commands.train_job.held_folder import HeldFolder
from nerf_lightning.compute import ranks
from nerf_lightning.config.auto_settings import CPU_SECONDS
from nerf_lightning.config.instantiate import build
from nerf_lightning.config.load_model import load_model
from nerf_lightning.config.open_checkpoint import LoadedModel, as_known
from nerf_lightning.config.overrides import to_type
from nerf_lightning.doctor.examine import advice
from nerf_lightning.export.base import Export
from nerf_lightning.files.folders import conf_file, option_names
from nerf_lightning.files.made_folders import make_folder, remove_empty
from nerf_lightning.files.yaml_files import read_plain_yaml
from nerf_lightning.messages.console import say
from nerf_lightning.messages.errors import InputError
from nerf_lightning.runs.curves import read_curves
from nerf_lightning.runs.file_steps import record_steps
from nerf_lightning.training.launch.lightning_flags import PROFILE

ROWS = 15  # Of the profile: the slowest actions, including everything they called
WIDTH = 54  # Characters of an action's name
# The path that is played, in ten seconds; `nerf export` takes that of conf/export.yaml.
PATH = {"num_frames": 120, "fps": 12}
# Of photographs: with 16 of them, 92 steps reached 21.6 dB, and 1,018 steps 27.8.
FEW_STEPS = 1_000
RISING = 1.5  # dB of training PSNR in the second half of a run
MEMORIZED = 6.0  # dB between training and held-out views, beyond which only more photographs help

log = logging.getLogger(__name__)


def show(job: TrainJob, held: HeldFolder, trainer: Trainer, psnr: float | None) -> None:
    """Close the loggers, note the result in a sentence, and write what the config specifies."""
    for logger in trainer.loggers:
        logger.finalize("success")
    if not ranks.is_first():
        return
    folder = held.path
    result, length = _result(job, folder, psnr, trainer.global_step)
    longer = " ".join([*resume_settings(), length]) if length else ""
    held.note(result=result, resume_with=longer)
    lines = profile_lines(trainer)
    if lines:
        say(*lines)
    for profile in sorted(folder.glob(f"fit-{PROFILE}*.txt")):
        log.info("profile: %s", profile)
    for name, what in job.post_training.exports.items():
        export_trained(name, what, job, folder)
    for name in option_names("final"):
        if job.config.final.get(name):
            write = build(DictConfig(read_plain_yaml(conf_file(f"final/{name}"))))
            say(f"result       {write(folder, job.checks)}: {result}")
    if length:
        say(f"train longer {resume_command(folder)} {length}")
    say(f"look at it   {_program()} view {to_type('ckpt', str(folder))} {trust_setting(job)}".rstrip())


def _program() -> str:
    """Return the command that starts this program: its path if the environment is not activated."""
    beside = Path(sys.executable).with_name("nerf")
    return "nerf" if shutil.which("nerf") or not beside.is_file() else os.path.relpath(beside)


def _result(job: TrainJob, folder: Path, psnr: float | None, steps: int) -> tuple[str, str]:
    """Return the result in a sentence with what would improve it most, and, if that is training, how long."""
    used, seconds = len(job.scene.view_names), job.config.budget.seconds
    total, what = used + len(job.scene.left_out), "photographs" if job.scene.truth is None else "views"
    quality = "" if psnr is None else f"PSNR {psnr:.1f} dB on {job.config.evaluation.split} views; "
    longer = 2 * steps if seconds is None else max(CPU_SECONDS, 2 * seconds)
    in_all = f"{longer:,} steps" if seconds is None else f"{longer:g} s"
    length = f"trainer.max_steps={longer}" if seconds is None else f"budget.seconds={longer:g}"
    cure = None if _still_learns(job, folder, psnr, steps) else advice(job.checks or ())
    cure, length = (f"train longer: {in_all} in all.", length) if cure is None else (f"{cure[0].lower()}{cure[1:]}", "")
    return f"{quality}{used} of {total} {what} used. To improve it, {cure}", length


def _still_learns(job: TrainJob, folder: Path, psnr: float | None, steps: int) -> bool:
    """Return whether more steps would help most: after few of them, or while the error falls fast in all views."""
    if steps < FEW_STEPS:
        return True
    try:
        _, values = read_curves(folder / "tensorboard")[f"PSNR/train_{job.system.model.level_names[-1]}"]
    except (InputError, KeyError):  # no such logger
        return False
    tenth = len(values) // 10
    if tenth == 0:
        return False
    reached, before = fmean(values[-tenth:]), fmean(values[4 * tenth : 5 * tenth])
    return reached - before > RISING and (psnr is None or reached - psnr < MEMORIZED)


def export_trained(name: str, what: Export, job: TrainJob, folder: Path) -> None:
    """Export the last checkpoint of a run as `nerf export` does, or log why it cannot be exported."""
    try:
        # From the file, as nerf export does: a model trained in bfloat16 is read in float32.
        checkpoint = read_checkpoint(folder / "checkpoints" / "last.ckpt")
        parts = [OmegaConf.to_container(part, resolve=True) for part in (job.config.model, job.config.correction)]
        own = modules_to_trust(parts)
        trained = LoadedModel(job.settings, checkpoint, load_model(checkpoint, own).to(job.settings.device), own)
        path = job.config.path.copy()
        path.update(PATH)
        target = make_folder(folder, "export")
        written = write_files(what, trained, as_known(job.scene, trained), build(path), target)
        record_steps(target, written, checkpoint.step)
        say(*(f"{name:<12} {file}" for file in written))
    except Exception as error:  # out of GPU memory, a full disk, a broken compiler: the run is complete all the same
        reason = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        log.warning(
            "The run is complete, but final.%s failed: %s nerf export ckpt=%s what=%s writes it later.",
            name,
            reason if reason.endswith(".") else f"{reason}.",
            folder,
            name,
        )
    finally:
        remove_empty(folder / "export")


def profile_lines(trainer: Trainer) -> list[str]:
    """Return the lines of the table; none without the simple profiler."""
    profiler = trainer.profiler  # type: ignore[attr-defined]
    if not isinstance(profiler, SimpleProfiler) or not profiler.recorded_durations:
        return []
    return list(_rows({action: list(taken) for action, taken in profiler.recorded_durations.items()}))


def _rows(durations: dict[str, list[float]]) -> Iterator[str]:
    """Yield a header and the actions that took longest.

    >>> print(*_rows({"[Callback]Monitor{'every': 1}.on_train_batch_end": [0.5, 1.5], "save": [0.25]}), sep="\\n")
    action                                                    calls   mean ms  seconds
    Monitor.on_train_batch_end                                    2    1000.0     2.00
    save                                                          1     250.0     0.25
    """
    yield f"{'action':<{WIDTH}}  {'calls':>7}  {'mean ms':>8}  {'seconds':>7}"
    longest = sorted(durations.items(), key=lambda item: sum(item[1]), reverse=True)
    for action, taken in longest[:ROWS]:
        mean = 1000.0 * sum(taken) / len(taken)
        yield f"{_short(action):<{WIDTH}}  {len(taken):>7}  {mean:>8.1f}  {sum(taken):>7.2f}"


def _short(action: str) -> str:
    """Return an action without its kind, and a callback without its settings."""
    name, brace, rest = action.rpartition("]")[2].partition("{")
    return (name + rest.rpartition("}")[2] if brace else name)[:WIDTH]

"""Write an HTML report of a run: metrics, worst views, curves, films, capture, protocol and config."""

from functools import partial
from pathlib import Path

from omegaconf import DictConfig

from nerf_lightning.config.instantiate import build
from nerf_lightning.config.overrides import to_type
from nerf_lightning.config.scene_overrides import scene_overrides
from nerf_lightning.doctor.check import Check
from nerf_lightning.doctor.examine import examine
from nerf_lightning.extensions.report.page import write_report
from nerf_lightning.extensions.report.read_run import read_run
from nerf_lightning.files.made_folders import require_no_way_out
from nerf_lightning.messages.console import say
from nerf_lightning.messages.errors import InputError, require_one_of
from nerf_lightning.runs.command_folder import output_folder
from nerf_lightning.runs.summary import FILES


def run(config: DictConfig) -> str:
    """Write the report and return the path of the page."""
    require_one_of(FILES, measured=config.measured)
    run = Path(str(config.run))
    if not (run / "run.json").is_file():
        raise InputError(
            f"run={run} is not a run folder: it has no run.json. Give one, such as outputs/bricks/2026-11-21_10-00-00."
        )
    require_no_way_out(run)
    target = output_folder(config.paths.output_dir, run) / "report.html"
    most_video_bytes = int(config.max_megabytes * 1e6)
    doctor = partial(_examine_capture, config) if config.doctor else None
    report = read_run(
        run, run / FILES[config.measured], most_video_bytes, doctor, target.parent, to_type("resume", str(run))
    )
    write_report(report, target)
    lines = [f"left out     {line}" for line in report.missing]
    say(*lines, f"report       {target} ({target.stat().st_size / 1e6:.1f} MB)")
    return str(target)


def _examine_capture(config: DictConfig) -> list[Check]:
    if config.get("scene") is None:
        # The run's own scene could not be read from its checkpoint: this says why.
        scene_overrides(str(Path(str(config.run)) / "checkpoints" / "last.ckpt"))
    return examine(build(config.scene).read())[1]

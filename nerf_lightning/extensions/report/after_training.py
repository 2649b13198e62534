"""The report at the end of a training, which has checked its capture already.

Whether it is written: `final.report` in conf/train.yaml, or if that is auto, `config/auto_settings.py`.
"""

from pathlib import Path

from nerf_lightning.config.overrides import to_type
from nerf_lightning.doctor.check import Check
from nerf_lightning.extensions.report.page import write_report
from nerf_lightning.extensions.report.read_run import read_run
from nerf_lightning.runs.summary import FILES


def write_after_training(folder: Path, checks: list[Check] | None, max_megabytes: int) -> Path:
    """Write `report.html` into a run's folder and return its path; None for `checks` leaves them out."""
    target, examine = folder / "report.html", None if checks is None else lambda: checks
    metrics, resume = folder / FILES["run"], to_type("resume", str(folder))
    write_report(read_run(folder, metrics, int(max_megabytes * 1e6), examine, resume=resume), target)
    return target

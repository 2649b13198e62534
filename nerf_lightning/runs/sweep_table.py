"""The table at the end of a sweep: a row per job, the best first."""

from pathlib import Path

from nerf_lightning.runs.summary import RunSummary, by_key, differing_keys, read_run, told_settings
from nerf_lightning.runs.sweep_job import JobRecord
from nerf_lightning.runs.table_files import Row


def job_rows(records: list[JobRecord], sweep_folder: Path) -> list[Row]:
    """Return a row per job, sorted by PSNR; what no job has, or all have the same of, is left out of the settings."""
    runs = {record.number: read_run(Path(record.folder)) for record in records}
    settings = {record.number: told_settings(by_key(record.overrides)) for record in records}
    swept = differing_keys(list(settings.values()))
    rows = []
    for record in sorted(records, key=lambda record: _rank(runs[record.number], record)):
        run = runs[record.number]
        row: Row = {"job": record.number} | {key: settings[record.number].get(key, "") for key in swept}
        row |= _results(run) if "finished" in record.state else dict.fromkeys(("PSNR", "SSIM", "steps", "seconds"))
        rows.append(row | {"state": record.state, "folder": _relative(run.folder, sweep_folder)})
    return rows


def _rank(run: RunSummary, record: JobRecord) -> tuple[bool, float, int]:
    known = run.psnr is not None and "finished" in record.state
    return not known, -(run.psnr or 0.0) if known else 0.0, record.number


def _results(run: RunSummary) -> Row:
    return {"PSNR": run.psnr, "SSIM": run.ssim, "steps": run.steps, "seconds": run.seconds}


def _relative(folder: Path, sweep_folder: Path) -> str:
    inside = folder.absolute().is_relative_to(sweep_folder.absolute())
    return str(folder.absolute().relative_to(sweep_folder.absolute())) if inside else str(folder)

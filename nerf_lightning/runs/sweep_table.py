"""The table at the end of a sweep: a row per job, the best first."""

from pathlib import Path
from typing import Any

from nerf_lightning.runs.summary import RunSummary, by_key, differing_keys, read_run, told_settings
from nerf_lightning.runs.sweep_job import JobRecord


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

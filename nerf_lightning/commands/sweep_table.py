"""The table at the end of a sweep: a row per job, the best first, printed and written as `sweep.md` and `sweep.csv`."""

import csv
import re
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from nerf_lightning.commands.run_summary import RunSummary, by_key, read_run
from nerf_lightning.commands.sweep_job import JobRecord
from nerf_lightning.export.atomic import whole_file

Row = dict[str, Any]

DECIMALS = {"PSNR": 2, "SSIM": 4, "seconds": 1}


def job_rows(records: list[JobRecord], sweep_folder: Path) -> list[Row]:
    """Return a row per job, sorted by PSNR; what no job has, or all have the same of, is left out of the settings."""
    runs = {record.number: read_run(Path(record.folder)) for record in records}
    settings = {record.number: by_key(record.overrides) for record in records}
    keys = dict.fromkeys(key for given in settings.values() for key in given)
    swept = [key for key in keys if len({given.get(key) for given in settings.values()}) > 1]
    rows = []
    for record in sorted(records, key=lambda record: _rank(runs[record.number], record)):
        run = runs[record.number]
        row: Row = {"job": record.number} | {key: settings[record.number].get(key, "") for key in swept}
        row |= _results(run) if "finished" in record.state else dict.fromkeys(("PSNR", "SSIM", "steps", "seconds"))
        rows.append(row | {"state": record.state, "folder": _relative(run.folder, sweep_folder)})
    return rows


def print_rows(rows: list[Row], title: str) -> None:
    """Print the table to the terminal, whole even where the terminal is narrow."""
    table = Table(title=title)
    for column in rows[0]:
        table.add_column(column, justify="right" if column in (*DECIMALS, "steps") else "left", overflow="fold")
    for row in rows:
        table.add_row(*_texts(row))
    console = Console()
    (console if console.is_terminal else Console(width=160)).print(table)


def write_rows(rows: list[Row], sweep_folder: Path) -> None:
    """Write `sweep.csv` with all digits and `sweep.md` for people."""
    columns = list(rows[0])
    with whole_file(sweep_folder / "sweep.csv") as part, part.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)
    lines = [columns, ["---"] * len(columns), *map(_texts, rows)]
    with whole_file(sweep_folder / "sweep.md") as part:
        part.write_text("".join(f"| {' | '.join(line)} |\n" for line in lines))


def _rank(run: RunSummary, record: JobRecord) -> tuple[bool, float, int]:
    known = run.psnr is not None and "finished" in record.state
    return not known, -(run.psnr or 0.0) if known else 0.0, record.number


def _results(run: RunSummary) -> Row:
    return {"PSNR": run.psnr, "SSIM": run.ssim, "steps": run.steps, "seconds": run.seconds}


def _texts(row: Row) -> list[str]:
    return [_text(key, value).replace("|", "\\|") for key, value in row.items()]


def _text(column: str, value: Any) -> str:
    if value is None:
        return ""
    if column in DECIMALS:
        return f"{value:.{DECIMALS[column]}f}"
    # What a sampler proposes has digits that nobody reads.
    is_long_number = re.fullmatch(r"-?\d*\.\d{7,}(e-?\d+)?", str(value))
    return f"{float(value):.6g}" if is_long_number else str(value)


def _relative(folder: Path, sweep_folder: Path) -> str:
    inside = folder.absolute().is_relative_to(sweep_folder.absolute())
    return str(folder.absolute().relative_to(sweep_folder.absolute())) if inside else str(folder)

"""Rows of a table, written as Markdown for reading and as CSV with all digits.

Texts from untrusted run folders stay text in a browser and a spreadsheet.
"""

import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nerf_lightning.files.atomic import whole_file
from nerf_lightning.messages.console import spoken
from nerf_lightning.messages.escaping import for_csv, for_markdown

Row = dict[str, Any]

DECIMALS = {
    **{"PSNR": 2, "PSNR std": 2, "cc PSNR": 2, "cc PSNR std": 2, "seconds": 1, "minutes": 1},
    **{"SSIM": 4, "SSIM std": 4, "LPIPS": 4, "LPIPS std": 4, "steps": 0, "parameters": 0, "runs": 0},
    **{"depth error": 4, "depth error std": 4, "normal error": 2, "normal error std": 2, "MB": 1, "frames/s": 3},
}
"""Columns of numbers, and their number of decimals."""
SECONDS = {"seconds": 1, "minutes": 60}  # Columns of times, and their units in seconds


def write_csv(rows: list[Row], path: Path) -> None:
    """Write the rows with all digits."""
    with whole_file(path) as part, part.open("w", encoding="utf-8", newline="") as file:
        lines = (rows[0], *(row.values() for row in rows))
        csv.writer(file).writerows(map(for_csv, line) for line in lines)


def write_markdown(rows: list[Row], path: Path, notes: Sequence[str] = ()) -> None:
    """Write the rows as a Markdown table, with the notes below."""
    head, *lines = ([*map(for_markdown, line)] for line in (rows[0], *([shown(row, c) for c in row] for row in rows)))
    text = "".join(f"| {' | '.join(line)} |\n" for line in (head, ["---"] * len(head), *lines))
    with whole_file(path) as part:
        part.write_text(text + "".join(f"\n{for_markdown(note)}\n" for note in notes), encoding="utf-8")


def shown_columns(rows: list[Row]) -> dict[str, list[str]]:
    """Return the displayed texts of each column.

    Deviations follow their means, all times are in one column, and published results are marked.
    """
    columns: dict[str, list[str]] = {}
    for name in rows[0]:
        if name in SECONDS or name == "time":
            columns["time"] = [_time(row) for row in rows]
        elif not name.endswith(" std"):
            deviations = [shown(row, f"{name} std") for row in rows]
            pairs = zip(rows, deviations, strict=True)
            columns[name] = [shown(row, name) + (f" ± {of}" if of else "") for row, of in pairs]
    if "model" in columns:
        columns["model"] = [f"{row['model']}{' (published)' if row.get('source') else ''}" for row in rows]
    return columns


def shown(row: Row, column: str) -> str:
    """Return the displayed text of a value."""
    value = row.get(column)
    if value is None:
        return ""
    if column in DECIMALS and not isinstance(value, str):
        return f"{value:,.{DECIMALS[column]}f}"
    # Values that a sampler proposes have too many digits.
    is_long_number = re.fullmatch(r"-?\d*\.\d{7,}(e-?\d+)?", str(value))
    return f"{float(value):.6g}" if is_long_number else str(value)


def _time(row: Row) -> str:
    times = (spoken(row[key] * seconds) for key, seconds in SECONDS.items() if row.get(key) is not None)
    return next(times, row.get("time") or "")

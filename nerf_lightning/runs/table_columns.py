"""The columns of a table: how many decimals each has, and how its values are shown.

Which columns there are: `job_rows` in `sweep.py`, and `extensions/table/rows.py`.
"""

import re
from typing import Any

from nerf_lightning.messages.console import spoken

Row = dict[str, Any]

DECIMALS = {
    **{"PSNR": 2, "PSNR std": 2, "cc PSNR": 2, "cc PSNR std": 2, "seconds": 1, "minutes": 1},
    **{"SSIM": 4, "SSIM std": 4, "LPIPS": 4, "LPIPS std": 4, "steps": 0, "parameters": 0, "runs": 0},
    **{"depth error": 4, "depth error std": 4, "normal error": 2, "normal error std": 2, "MB": 1, "frames/s": 3},
}
"""Columns of numbers, and their number of decimals."""
SECONDS = {"seconds": 1, "minutes": 60}  # Columns of times, and their units in seconds


def shown_columns(rows: list[Row]) -> dict[str, list[str]]:
    """Return the displayed texts of each column.

    Deviations follow their means, all times are in one column, and published results are marked.
    """
    columns: dict[str, list[str]] = {}
    for name in rows[0]:
        if name in SECONDS or name == "time":
            columns["time"] = [_time(row) for row in rows]
        elif not name.endswith(" std"):
            deviations = [cell_text(row, f"{name} std") for row in rows]
            pairs = zip(rows, deviations, strict=True)
            columns[name] = [cell_text(row, name) + (f" ± {of}" if of else "") for row, of in pairs]
    if "model" in columns:
        columns["model"] = [f"{row['model']}{' (published)' if row.get('source') else ''}" for row in rows]
    return columns


def cell_text(row: Row, column: str) -> str:
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

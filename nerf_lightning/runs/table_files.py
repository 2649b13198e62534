"""Rows of a table: printed, and written as markdown for people and as CSV with all digits.

Texts in them may come from anybody's run folders: they stay text, in a terminal, a browser and a spreadsheet.
"""

import csv
import re
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from nerf_lightning.console import StdoutConsole
from nerf_lightning.escaping import for_csv, for_markdown, for_terminal
from nerf_lightning.files.atomic import whole_file

Row = dict[str, Any]

DECIMALS = {
    **{"PSNR": 2, "PSNR std": 2, "SSIM": 4, "SSIM std": 4, "LPIPS": 4, "LPIPS std": 4, "seconds": 1, "minutes": 1},
    **{"depth error": 4, "depth error std": 4, "normal error": 2, "normal error std": 2, "MB": 1, "frames/s": 3},
}
COUNTS = ("steps", "parameters", "runs")


def print_rows(rows: list[Row], title: str) -> None:
    """Print the table to the terminal, whole even where the terminal is narrow, but for the ends of sources."""
    table = Table(title=Text(for_terminal(title)))
    for column in rows[0]:
        is_number = column in (*DECIMALS, *COUNTS)
        table.add_column(Text(for_terminal(column)), justify="right" if is_number else "left", overflow="fold")
    for row in rows:
        short = row | {"source": (row["source"] or "").partition(",")[0]} if "source" in row else row
        table.add_row(*(Text(for_terminal(text)) for text in _texts(short)))
    console = StdoutConsole()
    (console if console.is_terminal else StdoutConsole(width=160)).print(table)


def write_rows(rows: list[Row], folder: Path, name: str, notes: tuple[str, ...] = ()) -> None:
    """Write `NAME.csv` with all digits, and `NAME.md` with the notes below."""
    columns = list(rows[0])
    with whole_file(folder / f"{name}.csv") as part, part.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(map(for_csv, columns))
        writer.writerows([for_csv(value) for value in row.values()] for row in rows)
    head, *lines = ([*map(for_markdown, line)] for line in (columns, *map(_texts, rows)))
    text = "".join(f"| {' | '.join(line)} |\n" for line in (head, ["---"] * len(columns), *lines))
    with whole_file(folder / f"{name}.md") as part:
        part.write_text(text + "".join(f"\n{for_markdown(note)}\n" for note in notes), encoding="utf-8")


def _texts(row: Row) -> list[str]:
    return [_text(key, value) for key, value in row.items()]


def _text(column: str, value: Any) -> str:
    if value is None:
        return ""
    if column in DECIMALS and not isinstance(value, str):
        return f"{value:.{DECIMALS[column]}f}"
    if column in COUNTS and not isinstance(value, str):
        return f"{value:,.0f}"
    # What a sampler proposes has digits that nobody reads.
    is_long_number = re.fullmatch(r"-?\d*\.\d{7,}(e-?\d+)?", str(value))
    return f"{float(value):.6g}" if is_long_number else str(value)

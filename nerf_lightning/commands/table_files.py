"""Rows of a table: printed, and written as markdown for people and as CSV with all digits.

Texts in them may come from anybody's run folders: they stay text, in a terminal, a browser and a spreadsheet.
"""

import csv
import html
import re
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from nerf_lightning.commands.console import StdoutConsole
from nerf_lightning.export.atomic import whole_file

Row = dict[str, Any]

DECIMALS = {
    **{"PSNR": 2, "PSNR std": 2, "SSIM": 4, "SSIM std": 4, "LPIPS": 4, "LPIPS std": 4, "seconds": 1, "minutes": 1},
    **{"depth error": 4, "depth error std": 4, "normal error": 2, "normal error std": 2, "MB": 1, "frames/s": 3},
}
COUNTS = ("steps", "parameters", "runs")
FORMULAS = ("=", "+", "@")
"""What a spreadsheet takes for the beginning of a formula."""


def print_rows(rows: list[Row], title: str) -> None:
    """Print the table to the terminal, whole even where the terminal is narrow."""
    table = Table(title=Text(title))
    for column in rows[0]:
        is_number = column in (*DECIMALS, *COUNTS)
        table.add_column(Text(printable(column)), justify="right" if is_number else "left", overflow="fold")
    for row in rows:
        table.add_row(*(Text(text) for text in _texts(row)))
    console = StdoutConsole()
    (console if console.is_terminal else StdoutConsole(width=160)).print(table)


def write_rows(rows: list[Row], folder: Path, name: str, notes: tuple[str, ...] = ()) -> None:
    """Write `NAME.csv` with all digits, and `NAME.md` with the notes below."""
    columns = list(rows[0])
    # Texts from json may hold halves of letters, which UTF-8 has no bytes for.
    with whole_file(folder / f"{name}.csv") as part, part.open("w", -1, "utf-8", "replace", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(map(_cell, columns))
        writer.writerows([_cell(value) for value in row.values()] for row in rows)
    lines = [[printable(column) for column in columns], ["---"] * len(columns), *map(_texts, rows)]
    text = "".join(f"| {' | '.join(map(_markdown, line))} |\n" for line in lines)
    with whole_file(folder / f"{name}.md") as part:
        part.write_text(text + "".join(f"\n{_markdown(printable(note))}\n" for note in notes), encoding="utf-8")


def printable(text: str) -> str:
    """Return a text without what would steer a terminal or break a line."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def _texts(row: Row) -> list[str]:
    return [printable(_text(key, value)) for key, value in row.items()]


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


def _markdown(text: str) -> str:
    return html.escape(text, quote=False).replace("|", "\\|")


def _cell(value: Any) -> Any:
    return f"'{value}" if isinstance(value, str) and value.startswith(FORMULAS) else value

"""Rows of a table in files: Markdown for reading, CSV with all digits.

Texts from untrusted run folders stay text in a browser and a spreadsheet.
"""

import csv
from collections.abc import Sequence
from pathlib import Path

from nerf_lightning.files.atomic import whole_file
from nerf_lightning.messages.escaping import for_csv, for_markdown
from nerf_lightning.runs.table_columns import Row, cell_text


def write_csv(rows: list[Row], path: Path) -> None:
    """Write the rows with all digits."""
    with whole_file(path) as part, part.open("w", encoding="utf-8", newline="") as file:
        lines = (rows[0], *(row.values() for row in rows))
        csv.writer(file).writerows(map(for_csv, line) for line in lines)


def write_markdown(rows: list[Row], path: Path, notes: Sequence[str] = ()) -> None:
    """Write the rows as a Markdown table, with the notes below."""
    cells = ([cell_text(row, column) for column in row] for row in rows)
    head, *lines = ([*map(for_markdown, line)] for line in (rows[0], *cells))
    text = "".join(f"| {' | '.join(line)} |\n" for line in (head, ["---"] * len(head), *lines))
    with whole_file(path) as part:
        part.write_text(text + "".join(f"\n{for_markdown(note)}\n" for note in notes), encoding="utf-8")

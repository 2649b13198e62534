"""Rows of a table in a terminal: the columns that fit, the most important ones first, and the names of the others.

Texts from untrusted run folders stay text.
"""

import os
import sys
from collections.abc import Iterable

from rich import box
from rich.cells import cell_len
from rich.table import Table
from rich.text import Text

from nerf_lightning.messages.console import StdoutConsole, say
from nerf_lightning.messages.escaping import for_terminal, listed
from nerf_lightning.runs.table_columns import DECIMALS, Row, shown_columns

FIRST = ("job", "model", "PSNR", "resolution", "scene")
"""The most important columns, before the settings by which rows differ."""
NEXT = (
    *("state", "time", "steps", "SSIM", "cc PSNR", "seeds", "folder", "LPIPS"),
    *("depth error", "normal error", "parameters", "MB", "frames/s"),
)
"""The less important columns, in order."""
WIDE_TEXT = 20  # Longer texts are broken if other columns have no room
PIPED_WIDTH = 160


def print_rows(rows: list[Row], title: str, elsewhere: str) -> None:
    """Print a table with its title, and below it `elsewhere`: where to find columns that do not fit."""
    is_seen = "COLUMNS" in os.environ or sys.stdout.isatty() or sys.stderr.isatty()
    console = StdoutConsole(width=None if is_seen else PIPED_WIDTH)
    shown = shown_columns(rows)
    shown.pop("source", None)  # a word next to the model says as much
    columns = {_short(name, shown): cells for name, cells in shown.items()}
    if len(set(columns.get("scene", []))) == 1:
        title = f"{title}, scene {columns.pop('scene')[0]}"
    fitting, unbounded = dict[str, list[str]](), console.options.update_width(1 << 20)
    for name in sorted(columns, key=_worth):
        trial = {each: cells for each, cells in columns.items() if each in fitting or each == name}
        least = console.measure(_table(trial, rows, WIDE_TEXT), options=unbounded).minimum
        if name in FIRST[:3] or least <= console.width:
            fitting = trial
    say(title, "")
    console.print(_table(fitting, rows, None))
    say("")
    left_out = [name for name in columns if name not in fitting]
    if left_out:
        say(f"Columns left out: {listed(left_out, cap=20)}. {elsewhere}")


def _table(columns: dict[str, list[str]], rows: list[Row], widest: int | None) -> Table:
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for name, cells in columns.items():
        header = Text(for_terminal(name).replace(".", ".\n"))
        longest = max(map(cell_len, [*header.plain.split("\n"), *cells]))
        if name in DECIMALS:
            table.add_column(header, justify="right", no_wrap=True, min_width=longest)
        elif name == "folder":  # A broken path cannot be pasted.
            table.add_column(header, no_wrap=True, min_width=longest)
        else:
            table.add_column(header, overflow="fold", min_width=min(longest, WIDE_TEXT), max_width=widest)
    for number, row in enumerate(rows):
        if number and row.get("scene") != rows[number - 1].get("scene"):
            table.add_section()
        texts = (Text(for_terminal(cells[number])) for cells in columns.values())
        table.add_row(*texts, style="dim" if row.get("source") else None)
    return table


def _short(key: str, others: Iterable[str]) -> str:
    """Return the shortest suffix of a dotted key that distinguishes it from the others.

    >>> _short("model.fine.sampler.resolution", ["model.fine.sampler.resolution", "resolution"])
    'sampler.resolution'
    """
    words = key.split(".")
    ends = (".".join(words[first:]) for first in reversed(range(len(words))))
    return next((end for end in ends if sum(f".{each}".endswith(f".{end}") for each in others) == 1), key)


def _worth(name: str) -> tuple[int, int]:
    for rank, names in ((0, FIRST), (2, NEXT)):
        if name in names:
            return rank, names.index(name)
    return 1, 0

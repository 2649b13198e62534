"""Rows of a table in a terminal: the columns that fit it, the most telling ones first, and the names of the others.

Texts in them may come from anybody's run folders: they stay text.
"""

import os
import sys

from rich import box
from rich.cells import cell_len
from rich.table import Table
from rich.text import Text

from nerf_lightning.console import StdoutConsole, say
from nerf_lightning.escaping import for_terminal, listed
from nerf_lightning.runs.table_files import Row, is_number, told_columns

FIRST = ("job", "model", "PSNR", "resolution", "scene")
"""Columns that are worth most, before the settings by which rows differ."""
NEXT = (
    *("state", "time", "curve", "steps", "SSIM", "cc PSNR", "seeds", "folder", "LPIPS"),
    *("depth error", "normal error", "parameters", "MB", "frames/s"),
)
"""And those that are worth less, in their order."""
WIDE_TEXT = 20
"""Longer texts are broken where other columns have no room."""
GAP = 2
PIPED_WIDTH = 160

Columns = dict[str, list[str]]


def print_rows(rows: list[Row], title: str, elsewhere: str) -> None:
    """Print a table.

    Args:
        rows: all with the same columns.
        title: the line above it.
        elsewhere: where the columns are that do not fit, for the line below.
    """
    console = _console()
    told = told_columns(rows)
    told.pop("source", None)  # a word beside the model says as much
    short = short_names([name for name in told if "." in name], taken=list(told))
    columns = {
        for_terminal(short.get(name, name)): [for_terminal(text) for text in cells] for name, cells in told.items()
    }
    if len(set(columns.get("scene", []))) == 1:
        title = f"{title}, scene {columns.pop('scene')[0]}"
    widths = fitting(columns, console.width)
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, GAP - 1, 0, 0))
    for name, width in widths.items():
        table.add_column(
            Text(broken(name, width)), justify="right" if is_number(name) else "left", width=width, overflow="fold"
        )
    for number, row in enumerate(rows):
        if number and row.get("scene") != rows[number - 1].get("scene"):
            table.add_section()
        cells = (Text(columns[name][number]) for name in widths)
        table.add_row(*cells, style="dim" if row.get("source") else None)
    say(title, "")
    console.print(table)
    say("")
    left_out = [name for name in columns if name not in widths]
    if left_out:
        say(f"For {listed(left_out, cap=20)} this terminal is too narrow. {elsewhere}")


def fitting(columns: Columns, width: int) -> dict[str, int]:
    """Return the columns that fit, in their order, each with its width; headers are broken at blanks and dots alone.

    >>> fitting({"scene": ["lego"], "model": ["fast"], "PSNR": ["30.00"], "SSIM": ["0.9"]}, 20)
    {'scene': 5, 'model': 5, 'PSNR': 5}
    """
    least = {name: _least(name, cells) for name, cells in columns.items()}
    chosen: list[str] = []
    left = width + GAP
    for name in sorted(columns, key=_worth):
        if name in FIRST[:3] or least[name] + GAP <= left:
            chosen.append(name)
            left -= least[name] + GAP
    widths = {}
    for name in (name for name in columns if name in chosen):
        more = max(0, min(_longest([name, *columns[name]] if is_number(name) else columns[name]) - least[name], left))
        widths[name], left = least[name] + more, left - more
    return widths


def _least(name: str, cells: list[str]) -> int:
    longest = _longest(cells)
    return max(_longest(_parts(name)), longest if is_number(name) else min(longest, WIDE_TEXT))


def _parts(name: str) -> list[str]:
    return name.replace(".", ". ").split(" ")


def broken(name: str, width: int) -> str:
    r"""Return a header in lines of at most this width.

    >>> broken("scene.resolution", 12)
    'scene.\nresolution'
    """
    return name if cell_len(name) <= width else name.replace(".", ".\n")


def _longest(cells: list[str]) -> int:
    return max(map(cell_len, cells), default=0)


def _worth(name: str) -> tuple[int, int]:
    for place, names in ((0, FIRST), (2, NEXT)):
        if name in names:
            return place, names.index(name)
    return 1, 0


def short_names(keys: list[str], taken: list[str]) -> dict[str, str]:
    """Return the shortest ends of dotted keys that tell them apart.

    >>> short_names(["scene.space", "model.fine.sampler.resolution"], taken=["resolution"])
    {'scene.space': 'space', 'model.fine.sampler.resolution': 'sampler.resolution'}
    """
    short = {}
    for key in keys:
        words = key.split(".")
        ends = [".".join(words[place:]) for place in reversed(range(len(words)))]
        others = [other for other in (*keys, *taken) if other != key]
        short[key] = next(
            (end for end in ends if not any(other == end or other.endswith(f".{end}") for other in others)), key
        )
    return short


def _console() -> StdoutConsole:
    console = StdoutConsole()
    is_seen = console.is_terminal or "COLUMNS" in os.environ or sys.stderr.isatty()
    return console if is_seen else StdoutConsole(width=PIPED_WIDTH)

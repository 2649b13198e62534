"""The table that a person reads, and pastes into a bug report."""

from typing import Any

from rich.table import Table

from nerf_lightning.console import StdoutConsole, say, spoken
from nerf_lightning.selftest.check import Row

COLORS = {"ok": "green", "wrong": "bold red", "not run": "yellow"}


def print_rows(rows: list[Row], device: str, seconds: float) -> None:
    """Print the table, a line for each row that is not ok, and how many there are of each kind."""
    counts = {outcome: sum(row.outcome == outcome for row in rows) for outcome in COLORS}
    found = ", ".join(f"{count} {outcome}" for outcome, count in counts.items())
    StdoutConsole(width=120).print(result_table(rows, f"nerf selftest: {device}"))
    say(*remarks(rows), f"{found}; {spoken(seconds)}")


def result_table(rows: list[Row], title: str) -> Table:
    """Return the table: what was compared, the largest difference, the bound, and the verdict."""
    table = Table(title=title, title_justify="left")
    table.add_column("what")
    for name in ("largest difference", "bound"):
        table.add_column(name, justify="right")
    table.add_column("")
    for row in rows:
        found = "" if row.difference is None else f"{row.difference:.2g}"
        bound = "" if row.outcome == "not run" else f"{row.bound:.2g}"
        table.add_row(row.name, found, bound, f"[{COLORS[row.outcome]}]{row.outcome}[/]")
    return table


def remarks(rows: list[Row]) -> list[str]:
    """Return a line for each row that is not ok: why it was not run, or what is wrong."""
    lines = [f"not run: {row.name}: {row.note}" for row in rows if row.outcome == "not run"]
    for row in rows:
        if row.outcome == "wrong":
            rest = row.note if row.difference is None else f"{row.difference:.3g} exceeds {row.bound:.3g} ({row.note})"
            lines.append(f"WRONG: {row.name}: {rest}")
    return lines


def machine_lines(machine: dict[str, Any]) -> list[str]:
    """Return a line for each thing that is known of the machine.

    >>> machine_lines({"torch": "2.13", "threads": {"torch": 2, "of the machine": 4}, "gpus": ["A", "B"]})
    ['torch: 2.13', 'threads: torch 2, of the machine 4', 'gpus: A, B']
    """
    lines = []
    for name, value in machine.items():
        if isinstance(value, dict):
            value = ", ".join(f"{key} {part}" for key, part in value.items())
        elif isinstance(value, list):
            value = ", ".join(map(str, value))
        lines.append(f"{name.replace('_', ' ')}: {value}")
    return lines

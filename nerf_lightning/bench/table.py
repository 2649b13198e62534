"""`nerf bench`: the table that a person reads, and what stands in it."""

import statistics
from typing import Any

from rich.table import Table

from nerf_lightning.messages.console import StdoutConsole, spoken


def min_median_max(values: list[float]) -> dict[str, float]:
    """Return the median of the rounds, and their extremes."""
    return {"median": statistics.median(values), "min": min(values), "max": max(values)}


def print_table(result: dict[str, Any]) -> None:
    """Print the result of a benchmark, a row for each quantity."""
    table = Table(title=f"nerf bench: {result['machine']}, tiles of {result['tile_points']} points")
    for column in ("", "median", "min", "max"):
        table.add_column(column, justify="left" if not column else "right")
    for name, value in result.items():
        if isinstance(value, dict):
            table.add_row(name, *(f"{value[key]:,.3g}" if value[key] < 100 else f"{value[key]:,.0f}" for key in value))
    if result["seconds_and_steps_to_target_psnr"] is not None:
        seconds, steps = result["seconds_and_steps_to_target_psnr"]
        table.add_row("time to the target PSNR", spoken(seconds), f"{steps} steps", "")
    table.add_row("peak memory, GB", f"{result['peak_memory_gigabytes']:.2f}", "", "")
    StdoutConsole(width=100).print(table)

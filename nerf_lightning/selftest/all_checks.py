"""All checks, found by themselves: every file of `checks/` has a function `checks` that takes the place."""

import importlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from nerf_lightning.console import stderr_console
from nerf_lightning.selftest.check import Check, Row, carried_out
from nerf_lightning.selftest.place import Place

ORDER = ("kernels", "training", "files")
"""Who comes first; files that are not named here come last."""


def find_checks(place: Place) -> list[Check]:
    """Return the checks of every file."""
    names = {file.stem for file in (Path(__file__).parent / "checks").glob("*.py")} - {"__init__"}
    ordered = [*(name for name in ORDER if name in names), *sorted(names - set(ORDER))]
    modules = [importlib.import_module(f"nerf_lightning.selftest.checks.{name}") for name in ordered]
    return [check for module in modules for check in module.checks(place)]


def carry_out(checks: Iterable[Check], announce: Callable[[str], None]) -> list[Row]:
    """Do the checks one after the other; each is announced by its name before it begins."""
    rows = []
    for check in checks:
        announce(check.name)
        rows.append(carried_out(check))
    return rows


@contextmanager
def bar_of_checks(count: int) -> Iterator[Callable[[str], None]]:
    """Show a progress bar over this many checks; the function that is lent moves it on to the check of a name."""
    columns = (BarColumn(20), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=stderr_console(), transient=True) as bar:
        task = bar.add_task("", total=count, completed=-1)
        yield lambda name: bar.update(task, advance=1, description=name)

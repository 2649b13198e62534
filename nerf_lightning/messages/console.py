"""Terminal output: lines on stdout, progress bars on stderr; `conf/hydra/nerf.yaml` has the look of log lines.

Which warnings of Lightning are hidden: `_quiet_libraries` in `compute/devices.py`.
"""

import logging
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TaskProgressColumn, TimeRemainingColumn, track

from nerf_lightning.messages.escaping import for_terminal

DAY = 86_400
LINE_SECONDS = 30.0
"""Time between two lines of progress if no bar can be shown."""
FORESEEN_FROM = 0.05
"""Fraction done from which on they, and the bar of a training, show the remaining time: kernels are compiled at the
start, which therefore says little about the rest."""

Item = TypeVar("Item")
log = logging.getLogger(__name__)


def _speaks() -> bool:
    """Return whether this process reports for all processes of its run (`compute.ranks`, without importing torch)."""
    distributed = sys.modules.get("torch.distributed")
    return distributed is None or not distributed.is_initialized() or distributed.get_rank() == 0


def progress_bar(*columns: ProgressColumn | str, visible: bool = True) -> Progress:
    """Return a bar that disappears when done; it is silent if stderr is not a terminal."""
    console = Console(stderr=True)
    visible = visible and console.is_terminal and _speaks()
    return Progress(*columns, console=console, transient=True, disable=not visible)


class ProgressLines:
    """Log progress from time to time instead of a bar if there is no terminal."""

    def __init__(self) -> None:
        console = Console(stderr=True)
        self.visible = _speaks() and not console.is_terminal
        self.began = self.last_logged = time.monotonic()

    def __call__(self, what: str, fraction: float) -> None:
        """Log progress if it is time; `fraction` is of the whole."""
        now = time.monotonic()
        if not self.visible or now - self.last_logged < LINE_SECONDS or not 0 < fraction < 1:
            return
        self.last_logged = now
        left = f", about {spoken((now - self.began) * (1 - fraction) / fraction)} left"
        log.info("%s: %.0f %%%s", what, 100 * fraction, left if fraction >= FORESEEN_FROM else "")


def tracked(items: Sequence[Item], what: str) -> Iterator[Item]:
    """Yield the items and show progress: a bar on a terminal, elsewhere a line from time to time."""
    lines = ProgressLines()
    for done, item in enumerate(track(items, description=what, transient=True, console=stderr_console())):
        lines(what, done / len(items))
        yield item


class StageProgress:
    """One bar over stages of unequal cost, with the remaining time; one stage at a time goes from 0 to 1.

    Without a terminal, lines replace the bar from time to time. `costs` are in any one unit, in the stages' order.
    """

    def __init__(self, costs: Mapping[str, float]):
        self.costs = dict(costs)
        columns = ("{task.description}", BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
        self.bar, self.lines = progress_bar(*columns), ProgressLines()
        self.task = self.bar.add_task(next(iter(costs)), total=sum(costs.values()))

    def __enter__(self) -> "StageProgress":
        self.bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.bar.stop()

    def __call__(self, stage: str, fraction: float) -> None:
        """Set the progress of `stage` to this fraction, and complete all stages before it."""
        names = list(self.costs)
        before = sum(self.costs[name] for name in names[: names.index(stage)])
        completed = before + min(fraction, 1.0) * self.costs[stage]
        self.bar.update(self.task, description=stage, completed=completed)
        self.lines(stage, completed / sum(self.costs.values()))


def spoken(seconds: int | float) -> str:
    """Return a duration in words.

    >>> [spoken(seconds) for seconds in (7.4, 260, 3600, 3900, 187_200, 3_265_128)]
    ['7 s', '4 min 20 s', '1 h', '1 h 5 min', '2 days 4 h', '38 days']
    """
    whole = round(seconds)
    if whole >= 3 * DAY:
        return f"{round(whole / DAY)} days"
    units = ((DAY, "days" if whole >= 2 * DAY else "day"), (3600, "h"), (60, "min"), (1, "s"))
    place = next((number for number, (length, _) in enumerate(units) if whole >= length), len(units) - 1)
    words = []
    for length, name in units[place : place + 2]:
        count, whole = divmod(whole, length)
        words.append((count, name))
    return " ".join(f"{count} {name}" for count, name in words if count or len(words) == 1)


class _Label(logging.Filter):
    """The prefix of each line of this process; empty: none."""

    text = ""

    def filter(self, record: logging.LogRecord) -> bool:
        if not getattr(record, "is_labelled", False):
            record.msg, record.args, record.is_labelled = f"{self.text}{record.getMessage()}", (), True
        return True


_LABEL = _Label()


def label_lines(label: str) -> None:
    """Prefix all lines that this process prints and logs: it is one of several that share a terminal."""
    _LABEL.text = f"{for_terminal(label)} " if label else ""
    for handler in logging.getLogger().handlers:
        handler.addFilter(_LABEL)


def say(*lines: str) -> None:
    """Print lines to stdout; whatever they contain, each stays one line without control characters."""
    if lines:
        print("\n".join(f"{_LABEL.text}{for_terminal(line)}" for line in lines), flush=True)


def say_written(*paths: Path) -> None:
    """Print the paths of files, a line each, as all commands do."""
    say(*(f"{'written':<12} {path}" for path in paths))


class StdoutConsole(Console):
    """A console on stdout. If that is a closed pipe, rich would exit with 1; cli.process.ends_quietly decides."""

    def on_broken_pipe(self) -> None:
        """Reraise the current error."""
        raise


def stderr_console() -> Console:
    """Return a console on stderr, silent if that is not a terminal, and in all processes of a run but the first."""
    console = Console(stderr=True)
    console.quiet = not (console.is_terminal and _speaks())
    return console

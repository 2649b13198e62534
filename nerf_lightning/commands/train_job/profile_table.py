"""Lightning's profile as a table that a terminal can hold: what took longest, with all that it called."""

from collections.abc import Iterator

from lightning.pytorch import Trainer
from lightning.pytorch.profilers import SimpleProfiler

ROWS = 15
WIDTH = 54
"""Characters of an action's name."""


def profile_lines(trainer: Trainer) -> list[str]:
    """Return the lines of the table; none where the simple profiler has not looked."""
    profiler = trainer.profiler  # type: ignore[attr-defined]
    if not isinstance(profiler, SimpleProfiler) or not profiler.recorded_durations:
        return []
    return list(_rows({action: list(taken) for action, taken in profiler.recorded_durations.items()}))


def _rows(durations: dict[str, list[float]]) -> Iterator[str]:
    """Yield a header and the actions that took longest.

    >>> print(*_rows({"[Callback]Monitor{'every': 1}.on_train_batch_end": [0.5, 1.5], "save": [0.25]}), sep="\\n")
    action                                                    calls   mean ms  seconds
    Monitor.on_train_batch_end                                    2    1000.0     2.00
    save                                                          1     250.0     0.25
    """
    yield f"{'action':<{WIDTH}}  {'calls':>7}  {'mean ms':>8}  {'seconds':>7}"
    longest = sorted(durations.items(), key=lambda item: sum(item[1]), reverse=True)
    for action, taken in longest[:ROWS]:
        mean = 1000.0 * sum(taken) / len(taken)
        yield f"{_short(action):<{WIDTH}}  {len(taken):>7}  {mean:>8.1f}  {sum(taken):>7.2f}"


def _short(action: str) -> str:
    """Return an action without its kind, and a callback without its settings."""
    name, brace, rest = action.rpartition("]")[2].partition("{")
    return (name + rest.rpartition("}")[2] if brace else name)[:WIDTH]

"""A check computes something twice, and reports the difference and its bound.

Which check has which bound: `kernels.py` and `training.py`. Bounds of rounding: `value_bound` and `gradient_bound`.
"""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from rich.table import Table
from torch import Tensor

from nerf_lightning.nerf.matmul_precision import MatmulPrecision

UNIT: dict[MatmulPrecision, float] = {"float32": 2.0**-24, "tf32": 2.0**-11, "bfloat16": 2.0**-9}
"""The largest relative error of rounding a number to nearest, for each kind of factor."""
COLORS = {"ok": "green", "wrong": "bold red", "not run": "yellow"}
log = logging.getLogger(__name__)


class CannotRun(Exception):
    """Something that a check needs is missing; the text says what, and what is used instead."""


@dataclass(frozen=True)
class Check:
    """Something that a machine must compute correctly."""

    name: str
    bound: float
    """The largest acceptable difference."""
    because: str
    """Where the bound comes from."""
    difference: Callable[[], float]
    """Computes and compares. Raises `CannotRun` if something needed is missing."""


@dataclass(frozen=True)
class Row:
    """The result of a check: a row of the table."""

    name: str
    difference: float | None
    bound: float
    outcome: Literal["ok", "wrong", "not run"]
    note: str
    """The reason for the bound, what went wrong, or why the check was not run."""


def carried_out(check: Check) -> Row:
    """Run a check and judge it. Whatever it raises counts as wrong, so that the others still run."""
    try:
        difference = float(check.difference())
    except CannotRun as reason:
        return Row(check.name, None, check.bound, "not run", str(reason))
    except Exception as error:  # anything may be broken here, and any error is a result
        log.debug(check.name, exc_info=True)
        return Row(check.name, None, check.bound, "wrong", " ".join(f"{type(error).__name__}: {error}".split())[:300])
    fits = difference <= check.bound  # nan does not
    return Row(check.name, difference, check.bound, "ok" if fits else "wrong", check.because)


def relative(actual: Tensor, expected: Tensor) -> float:
    """Return the largest difference of two tensors over the largest expected value; NaN if a value is.

    >>> relative(Tensor([1.0, 2.5]), Tensor([1.0, 2.0]))
    0.25
    """
    if actual.shape != expected.shape:
        raise ValueError(f"the result has the shape {tuple(actual.shape)}, and {tuple(expected.shape)} is expected")
    actual, expected = actual.detach().cpu().double(), expected.detach().cpu().double()
    return float((actual - expected).abs().max() / expected.abs().max().clamp(min=1e-30))


def norm_apart(actual: Tensor, expected: Tensor) -> float:
    """Return the norm of a difference over the norm of the expected value; NaN if a number is."""
    actual, expected = actual.detach().cpu().double(), expected.detach().cpu().double()
    return float((actual - expected).norm() / expected.norm().clamp(min=1e-30))


def value_bound(matmul_precision: MatmulPrecision, layers: int) -> float:
    """Return how far rounding moves the output of an MLP with `layers` layers, over its norm.

    A layer rounds both factors of its products, and perhaps its result: 3 roundings; for float32, the random walk of a
    sum of 64 terms: 8. Errors of layers are independent, so they add up as sqrt(layers); 4 standard deviations.
    """
    return 4.0 * layers**0.5 * _of_a_layer(matmul_precision)


def gradient_bound(matmul_precision: MatmulPrecision, layers: int) -> float:
    """Return how far rounding moves the gradient of an MLP with ReLUs, over its norm.

    An error e before a ReLU, relative to the spread of its inputs, switches the unit with probability e / pi; half of
    the units are on, so a share 2 e / pi of a layer's signal appears or disappears, and squares add up over the layers.
    """
    return (layers * 2.0 * layers**0.5 * _of_a_layer(matmul_precision) / math.pi) ** 0.5


def _of_a_layer(matmul_precision: MatmulPrecision) -> float:
    return (8.0 if matmul_precision == "float32" else 3.0) * UNIT[matmul_precision]


def result_table(rows: list[Row], title: str) -> Table:
    """Return a table of what was compared, the largest difference, the bound, and the verdict."""
    table = Table("what", title=title, title_justify="left")
    for name in ("largest difference", "bound", ""):
        table.add_column(name, justify="right" if name else "left")
    for row in rows:
        found = "" if row.difference is None else f"{row.difference:.2g}"
        table.add_row(row.name, found, f"{row.bound:.2g}", f"[{COLORS[row.outcome]}]{row.outcome}[/]")
    return table


def remarks(rows: list[Row]) -> list[str]:
    """Return a line for each row that is not ok: why it was not run, or what is wrong."""
    lines = [f"not run: {row.name}: {row.note}" for row in rows if row.outcome == "not run"]
    for row in (each for each in rows if each.outcome == "wrong"):
        rest = row.note if row.difference is None else f"{row.difference:.3g} exceeds {row.bound:.3g} ({row.note})"
        lines.append(f"WRONG: {row.name}: {rest}")
    return lines

"""The contract of a check: it computes something twice and says how far the two are apart, and how far they may be."""

import math
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

from torch import Tensor

from nerf_lightning.nerf.products import Products

UNIT: dict[Products, float] = {"float32": 2.0**-24, "tf32": 2.0**-11, "bfloat16": 2.0**-9}
"""The largest relative error of rounding a number to nearest, for each kind of factor."""
MOST_LETTERS = 300

Outcome = Literal["ok", "wrong", "not run"]


class CannotRun(Exception):
    """What a check needs is not here; its text says what, and what does the work instead."""


@dataclass(frozen=True)
class Check:
    """One thing that a machine must compute right."""

    name: str
    """What is compared."""
    bound: float
    """The largest difference that is right."""
    because: str
    """Where the bound comes from, in words."""
    difference: Callable[[], float]
    """Compute and compare. Raises `CannotRun` where something needed is not here."""


@dataclass(frozen=True)
class Row:
    """What a check found: a row of the table."""

    name: str
    difference: float | None
    bound: float
    outcome: Outcome
    note: str
    """What the bound rests on; or what went wrong, or why it was not run."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for json."""
        return asdict(self)


def carried_out(check: Check) -> Row:
    """Do a check and judge it. Whatever it raises is shown as wrong, so that the others still run."""
    try:
        difference = float(check.difference())
    except CannotRun as reason:
        return Row(check.name, None, check.bound, "not run", str(reason))
    except Exception as error:  # anything may be broken here, and all of it is an answer
        return Row(check.name, None, check.bound, "wrong", _told(error))
    fits = math.isfinite(difference) and difference <= check.bound
    return Row(check.name, difference, check.bound, "ok" if fits else "wrong", check.because)


def relative(found: Tensor, expected: Tensor) -> float:
    """Return the largest difference of two tensors over the largest value that is expected; nan where one is.

    >>> relative(Tensor([1.0, 2.5]), Tensor([1.0, 2.0]))
    0.25
    """
    if found.shape != expected.shape:
        raise ValueError(f"the result has the shape {tuple(found.shape)}, and {tuple(expected.shape)} is expected")
    if not expected.numel():
        return 0.0
    found, expected = found.detach().cpu().double(), expected.detach().cpu().double()
    return float((found - expected).abs().max() / expected.abs().max().clamp(min=1e-30))


def value_bound(products: Products, layers: int) -> float:
    """Return how far rounding moves what a perceptron of so many layers computes, over its norm.

    A layer rounds both factors of its products, and perhaps its result: 3 roundings, where float32 counts the random
    walk of a sum of 64 terms, 8. Errors of layers are independent, so they add up as sqrt(layers); 4 standard
    deviations.
    """
    return 4.0 * layers**0.5 * _of_a_layer(products)


def gradient_bound(products: Products, layers: int) -> float:
    """Return how far rounding moves the gradient of a perceptron with ReLUs, over its norm.

    An error e before a ReLU, relative to the spread of what comes there, switches the unit with probability e / pi;
    half of them are on, so a share 2 e / pi of a layer's signal comes or goes, and squares add up over the layers.
    """
    error = layers**0.5 * _of_a_layer(products)
    return (layers * 2.0 * error / math.pi) ** 0.5


def _of_a_layer(products: Products) -> float:
    return (8.0 if products == "float32" else 3.0) * UNIT[products]


def norm_apart(found: Tensor, expected: Tensor) -> float:
    """Return the norm of a difference over the norm of what is expected; nan where a number is."""
    found, expected = found.detach().cpu().double(), expected.detach().cpu().double()
    return float((found - expected).norm() / expected.norm().clamp(min=1e-30))


def largest(differences: list[float]) -> float:
    """Return the largest of some differences; nan counts as larger than any number."""
    return max(differences, key=lambda value: math.inf if math.isnan(value) else value)


def _told(error: Exception) -> str:
    text = " ".join(f"{type(error).__name__}: {error}".split())[:MOST_LETTERS]
    # The last line of ours: the first is that of this file.
    frames = [each for each in traceback.extract_tb(error.__traceback__) if "nerf_lightning" in each.filename][1:]
    return f"{text} (line {frames[-1].lineno} of {frames[-1].filename.rpartition('/')[2]})" if frames else text

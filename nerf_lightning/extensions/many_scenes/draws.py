"""Random numbers of a model of the family: each is a hash of the model's number and of its purpose."""

import hashlib
from collections.abc import Sequence
from typing import TypeVar

from nerf_lightning.data.bricks.parts import ALONG_Z, Material, Part, Triple, rod

Choice = TypeVar("Choice")

COLORS: tuple[Triple, ...] = (
    (0.86, 0.10, 0.08),
    (0.94, 0.94, 0.92),
    (0.99, 0.79, 0.08),
    (0.05, 0.35, 0.82),
    (0.10, 0.55, 0.22),
    (0.95, 0.46, 0.07),
    (0.40, 0.72, 0.86),
    (0.52, 0.20, 0.60),
    (0.62, 0.80, 0.20),
    (0.45, 0.26, 0.14),
    (0.88, 0.76, 0.56),
    (0.93, 0.48, 0.64),
    (0.30, 0.32, 0.35),
    (0.06, 0.50, 0.50),
    (0.60, 0.08, 0.16),
    (0.12, 0.16, 0.38),
)
"""Of bricks, sRGB-encoded."""


def studs(xs: list[float], ys: list[float], z: float, material: Material) -> list[Part]:
    """Return a grid of studs at height `z`."""
    return [rod((x, y, z + 0.11), 0.3, 0.22, ALONG_Z, material) for x in xs for y in ys]


class Draws:
    """The random numbers of one model.

    >>> Draws(7).number("length", 2.0, 3.0) == Draws(7).number("length", 2.0, 3.0)
    True
    >>> Draws(7).number("length", 2.0, 3.0) == Draws(8).number("length", 2.0, 3.0)
    False

    Args:
        variant: the model's number.
    """

    def __init__(self, variant: int):
        self.variant = variant

    def number(self, what: str, low: float, high: float) -> float:
        """Return a uniform number between `low` and `high`."""
        word = hashlib.sha256(f"bricks {self.variant} {what}".encode()).digest()[:4]
        return low + (high - low) * int.from_bytes(word, "big") / 2**32

    def whole(self, what: str, low: int, high: int) -> int:
        """Return an integer from `low` to `high`, inclusive."""
        return int(self.number(what, float(low), float(high + 1)))

    def pick(self, what: str, options: Sequence[Choice]) -> Choice:
        """Return one of the options."""
        return options[self.whole(what, 0, len(options) - 1)]

    def chance(self, what: str, share: float) -> bool:
        """Return true in the share `share` of the models."""
        return self.number(what, 0.0, 1.0) < share

    def paints(self, count: int) -> list[Material]:
        """Return materials of bricks with distinct colors."""
        left, paints = list(COLORS), []
        for number in range(count):
            color = left.pop(self.whole(f"paint.{number}", 0, len(left) - 1))
            shine = self.number(f"shine.{number}", 0.1, 0.5)
            paints.append(Material(color, specular=shine))
        return paints

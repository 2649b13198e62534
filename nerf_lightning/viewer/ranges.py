"""Numbers of the panel: a browser may send what its control does not have."""

from typing import TypeVar

Number = TypeVar("Number", int, float)


def within(value: Number, least: Number, most: Number) -> Number:
    """Return the nearest number in a range: a browser may send what its slider does not have.

    >>> within(7, 0, 5)
    5
    """
    return min(max(value, least), most)

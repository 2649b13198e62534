"""A few of many views, evenly spread over all."""

from collections.abc import Sequence


def spread(views: Sequence[int], most: int) -> list[int]:
    """Return at most so many of the views, spread over all.

    >>> spread([3, 4, 5, 6], 2)
    [3, 5]
    """
    count = min(most, len(views))
    return [views[i * len(views) // count] for i in range(count)]

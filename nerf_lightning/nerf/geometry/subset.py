"""A subset of the views, evenly spaced."""

from collections.abc import Sequence


def evenly_spaced_subset(views: Sequence[int], most: int) -> list[int]:
    """Return at most `most` of the views, evenly spaced.

    >>> evenly_spaced_subset([3, 4, 5, 6], 2)
    [3, 5]
    """
    count = min(most, len(views))
    return [views[i * len(views) // count] for i in range(count)]

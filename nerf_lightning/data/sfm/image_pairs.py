"""Choose which photographs are compared with each other.

That a film's frames are matched in sequence is decided in `find_poses.py`.
"""

from itertools import combinations, groupby
from typing import Literal

Matching = Literal["exhaustive", "sequential", "auto"]
MOST_EXHAUSTIVE = 80
NEIGHBOURS = 10
LANDMARKS = 40
TILE = 12


def chosen_matching(matching: Matching, count: int) -> Matching:
    """Return how `count` photographs are compared: `auto` means all pairs if these are few (3160 for 80)."""
    if matching != "auto":
        return matching
    return "exhaustive" if count <= MOST_EXHAUSTIVE else "sequential"


def image_pairs(matching: Matching, count: int) -> list[tuple[int, int]]:
    """Return pairs (i, j), i < j, of photographs 0 to count - 1 in the order in which they were taken.

    Sequential: the next ten, those at a distance of a power of two, and all pairs among some forty spread over the
    whole, to close loops of the path. The number grows with count log count.

    >>> image_pairs("exhaustive", 3)
    [(0, 1), (0, 2), (1, 2)]
    >>> (0, 10) in image_pairs("sequential", 100), (0, 11) in image_pairs("sequential", 100)
    (True, False)
    """
    if chosen_matching(matching, count) == "exhaustive":
        return list(combinations(range(count), 2))
    steps = {*range(1, NEIGHBOURS + 1), *(2**power for power in range(count.bit_length()))}
    near = {(i, i + step) for i in range(count) for step in steps if i + step < count}
    landmarks = range(0, count, -(-count // LANDMARKS))
    return sorted(near | set(combinations(landmarks, 2)))


def tiles_of(pairs: list[tuple[int, int]]) -> list[list[tuple[int, int]]]:
    """Group the pairs by few photographs each: comparing a group loads and indexes each photograph once."""

    def tile(pair: tuple[int, int]) -> tuple[int, int]:
        return pair[0] // TILE, pair[1] // TILE

    return [list(group) for _, group in groupby(sorted(pairs, key=tile), key=tile)]

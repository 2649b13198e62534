"""Chunks of rows, for work that needs much memory per pixel of a large picture."""

from collections.abc import Iterator

CHUNK_PIXELS = 1 << 18


def row_chunks(height: int, width: int) -> Iterator[slice]:
    """Yield the rows of a picture in chunks of about a quarter of a million pixels, from the top.

    >>> [(rows.start, rows.stop) for rows in row_chunks(5, 100_000)]
    [(0, 2), (2, 4), (4, 5)]
    """
    rows = max(1, CHUNK_PIXELS // width)
    return (slice(top, min(top + rows, height)) for top in range(0, height, rows))

"""The resolution of each level of a multiresolution hash grid, and where its entries are (Sec. 3, arXiv 2201.05989).

Letters: R_l the cells along a side of level l, T the maximum number of entries of a level's table.
"""

from dataclasses import dataclass

PRIME_Y, PRIME_Z = 2654435761, 805459861
"""Primes of the spatial hash: XOR of each coordinate times its prime (1 for x), modulo the table size (Eq. 4)."""


@dataclass(frozen=True)
class HashGridLayout:
    """Where each level's entries are in the shared table."""

    resolutions: tuple[int, ...]
    """R_l, cells along a side."""
    offsets: tuple[int, ...]
    """First entry of each level, and the total number of entries."""
    table_size: int
    """T, a power of two."""

    def is_hashed(self, level: int) -> bool:
        """Return whether a level has more vertices than its table has entries."""
        return (self.resolutions[level] + 1) ** 3 > self.table_size

    def coarsest(self, levels: int) -> "HashGridLayout":
        """Return the layout of the `levels` coarsest levels, in the same table."""
        return HashGridLayout(self.resolutions[:levels], self.offsets[: levels + 1], self.table_size)


def hash_grid_layout(num_levels: int, log2_table_size: int, min_resolution: int, max_resolution: int) -> HashGridLayout:
    """Return the layout: resolutions grow geometrically (Eq. 2, 3); dense where a level's vertices fit (Sec. 3).

    >>> hash_grid_layout(num_levels=2, log2_table_size=4, min_resolution=1, max_resolution=4)
    HashGridLayout(resolutions=(1, 4), offsets=(0, 8, 24), table_size=16)
    """
    growth = (max_resolution / min_resolution) ** (1.0 / max(1, num_levels - 1))
    resolutions = tuple(int(min_resolution * growth**level + 1e-6) for level in range(num_levels))
    offsets = [0]
    for resolution in resolutions:
        offsets.append(offsets[-1] + min(1 << log2_table_size, (resolution + 1) ** 3))
    return HashGridLayout(resolutions, tuple(offsets), 1 << log2_table_size)

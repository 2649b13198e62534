"""A radiance field as bytes in blocks: what a page holds, as one run of bytes and back, and how they are read."""

import gzip
import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Integer, UInt8
from numpy import ndarray

from nerf_lightning.export.baking.contraction import Contraction
from nerf_lightning.export.voxel_kernels.layout import SIDE, TILE

LEAST_EXPONENT, MOST_EXPONENT = -8.0, 4.0
"""Powers of two between which optical depths per voxel are kept: below is nothing, above is solid."""
EXPONENT_STEP = (MOST_EXPONENT - LEAST_EXPONENT) / 255.0
LEAST_MET = 0.3  # Where no light comes from behind: rays that meet less than this do not end in the scene.
NO_CHANGE = 128  # The byte of a coefficient that is nothing.
LEVEL = 6  # Of gzip; higher ones take many times as long, for one part in a hundred.


@dataclass(frozen=True)
class BakedField:
    """Density and color at the corners of a lattice, in blocks of 8 x 8 x 8 values.

    A byte q of density is an optical depth of 2^(a + b q) - 2^a along a way as long as a voxel (its longest side): a
    step of any length has its own opacity.
    Color is a sum of real spherical harmonics of the viewing direction; bytes of the first are its color, bytes of
    the others go from -range to range, with nothing at 128.
    """

    lower: tuple[float, float, float]
    """Where the first value stands, scene units."""
    spacing: tuple[float, float, float]
    """Scene units between values, along each axis."""
    shape: tuple[int, int, int]
    """Blocks along each axis."""
    blocks: Int[ndarray, "blocks"]
    """Which blocks there are: x * (ny * nz) + y * nz + z, rising."""
    density: UInt8[ndarray, "blocks 8 8 8"]
    colored: Bool[ndarray, "blocks 8 8 8"]
    """Which values have a color: those that can be seen."""
    colors: UInt8[ndarray, "channels colored"]
    """Three channels for each spherical harmonic; the colored values in their order."""
    ranges: tuple[float, float]
    """Half range of the coefficients of degree 1 and 2."""
    contraction: Contraction | None = None
    """Of a scene without bounds: lower and spacing are in its contracted cube."""
    closed: bool = False
    """Whether no light comes from behind all this: what rays miss, since it was left out, is as what they meet."""

    @property
    def num_harmonics(self) -> int:
        """How many spherical harmonics a color has: 1, 4 or 9."""
        return len(self.colors) // 3

    @property
    def length(self) -> float:
        """The longest side of a voxel, scene units."""
        return max(self.spacing)

    @property
    def index(self) -> Int[ndarray, "x y z"]:
        """The number of each block, -1 where there is none."""
        index = np.full(math.prod(self.shape), -1, np.int32)
        index[self.blocks] = np.arange(len(self.blocks))
        return index.reshape(self.shape)

    def channel(self, number: int) -> UInt8[ndarray, "blocks 8 8 8"]:
        """Return a channel of all values; those without a color are black, and the same from all sides."""
        values = np.full(self.colored.shape, 0 if number < 3 else NO_CHANGE, np.uint8)
        values[self.colored] = self.colors[number]
        return values

    @property
    def scale(self) -> Float[ndarray, "numbers"]:
        """How bytes become numbers, as the marcher takes it."""
        return np.array([LEAST_EXPONENT, EXPONENT_STEP, *self.ranges], np.float32)


def to_bytes_of_density(optical: Float[ndarray, "*any"]) -> UInt8[ndarray, "*any"]:
    """Return the bytes of optical depths per voxel.

    >>> to_bytes_of_density(np.array([0.0, 0.05, 1.0, 1e9])).tolist()
    [0, 80, 170, 255]
    """
    exponent = np.log2(optical + 2.0**LEAST_EXPONENT)
    return np.rint(np.clip((exponent - LEAST_EXPONENT) / EXPONENT_STEP, 0, 255)).astype(np.uint8)


def tiles_of(
    values: Integer[ndarray, "blocks 8 8 8"], index: Int[ndarray, "x y z"], empty: int
) -> Integer[ndarray, "blocks 9 9 9"]:
    """Return the blocks with a border beyond their last values: the first ones of the next blocks, else `empty`."""
    tiles = np.full((len(values), TILE, TILE, TILE), empty, values.dtype)
    tiles[:, :SIDE, :SIDE, :SIDE] = values
    place = np.argwhere(index >= 0)
    padded = np.pad(index, ((0, 1),) * 3, constant_values=-1)
    own, border = slice(0, SIDE), SIDE
    for a, b, c in list(np.ndindex(2, 2, 2))[1:]:
        other = padded[tuple((place + np.array([a, b, c])).T)]
        there = other >= 0
        part = tiles[(slice(None), *(border if each else own for each in (a, b, c)))]
        part[there] = values[(other[there], *(0 if each else own for each in (a, b, c)))]
    return tiles


def described(baked: BakedField) -> dict[str, Any]:
    """Return what must be known to read the bytes, as JSON has it."""
    return {
        "lower": list(baked.lower),
        "spacing": list(baked.spacing),
        "length": baked.length,
        "shape": list(baked.shape),
        "blocks": len(baked.blocks),
        "colored": int(baked.colors.shape[1]),
        "harmonics": baked.num_harmonics,
        "exponents": [LEAST_EXPONENT, EXPONENT_STEP],
        "ranges": list(baked.ranges),
        "closed": baked.closed,
        "contraction": None if baked.contraction is None else asdict(baked.contraction),
    }


def serialized(baked: BakedField) -> bytes:
    """Return the bytes, compressed: blocks' numbers, densities, which values are colored (bits), then each channel."""
    parts = (
        baked.blocks.astype("<i4"),
        baked.density,
        np.packbits(baked.colored, bitorder="little"),
        np.ascontiguousarray(baked.colors),
    )
    # Without a time: the same field makes the same file.
    return gzip.compress(b"".join(part.tobytes() for part in parts), LEVEL, mtime=0)

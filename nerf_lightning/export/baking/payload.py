"""A baked field as one run of bytes, and back."""

import gzip
import zlib
from dataclasses import asdict
from typing import Any

import numpy as np

from nerf_lightning.errors import InputError
from nerf_lightning.export.baking.baked_field import EXPONENT_STEP, LEAST_EXPONENT, BakedField
from nerf_lightning.export.baking.contraction import Contraction
from nerf_lightning.nerf.kernels.bricks.layout import SIDE

LEVEL = 6
"""Of gzip; higher ones take many times as long, for one part in a hundred."""


def described(baked: BakedField) -> dict[str, Any]:
    """Return what must be known to read the bytes, as JSON has it."""
    return {
        "lower": list(baked.lower),
        "spacing": list(baked.spacing),
        "length": baked.length,
        "shape": list(baked.shape),
        "bricks": len(baked.bricks),
        "colored": int(baked.colors.shape[1]),
        "harmonics": baked.num_harmonics,
        "exponents": [LEAST_EXPONENT, EXPONENT_STEP],
        "ranges": list(baked.ranges),
        "closed": baked.closed,
        "contraction": None if baked.contraction is None else asdict(baked.contraction),
    }


def packed(baked: BakedField) -> bytes:
    """Return the bytes, compressed: bricks' numbers, densities, which values are coloured (bits), then each channel."""
    parts = (
        baked.bricks.astype("<i4"),
        baked.density,
        np.packbits(baked.colored, bitorder="little"),
        np.ascontiguousarray(baked.colors),
    )
    # Without a time: the same field makes the same file.
    return gzip.compress(b"".join(part.tobytes() for part in parts), LEVEL, mtime=0)


def unpacked(about: dict[str, Any], content: bytes) -> BakedField:
    """Return the field.

    Args:
        about: as `described` says it.
        content: as `packed` returned it.

    Raises:
        InputError: they are not, or not whole.
    """
    try:
        raw = gzip.decompress(content)
        bricks, colored, channels = int(about["bricks"]), int(about["colored"]), 3 * int(about["harmonics"])
        sizes = (4 * bricks, SIDE**3 * bricks, SIDE**3 * bricks // 8, channels * colored)
        if len(raw) != sum(sizes):
            raise ValueError(f"{len(raw)} bytes, and not {sum(sizes)}")
        numbers, density, bits, colors = (
            np.frombuffer(part, np.uint8)
            for part in (raw[sum(sizes[:i]) : sum(sizes[: i + 1])] for i in range(len(sizes)))
        )
        x, y, z = about["lower"]
        along_x, along_y, along_z = about["spacing"]
        nx, ny, nz = about["shape"]
        low, high = about["ranges"]
        outside = about["contraction"]
        if outside is not None:
            cx, cy, cz = map(float, outside["center"])
            outside = Contraction((cx, cy, cz), float(outside["half"]), float(outside["near"]))
        return BakedField(
            (x, y, z),
            (along_x, along_y, along_z),
            (nx, ny, nz),
            numbers.view("<i4").astype(np.int32),
            density.reshape(bricks, SIDE, SIDE, SIDE),
            np.unpackbits(bits, bitorder="little").astype(bool).reshape(bricks, SIDE, SIDE, SIDE),
            colors.reshape(channels, colored),
            (low, high),
            outside,
            bool(about["closed"]),
        )
    except (OSError, EOFError, zlib.error, KeyError, TypeError, ValueError) as error:
        raise InputError(f"The field in the page is damaged or cut off: {error}. Export it again.") from error

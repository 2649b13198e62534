"""Point clouds as binary PLY."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from nerf_lightning.export.atomic import whole_file

NUMBERS, COLORS = ("x", "y", "z", "nx", "ny", "nz"), ("red", "green", "blue")
LAYOUT = np.dtype([*((name, "<f4") for name in NUMBERS), *((name, "u1") for name in COLORS)])


def save_points(
    path: Path,
    points: Float[ndarray, "points 3"],
    normals: Float[ndarray, "points 3"],
    colors: UInt8[ndarray, "points 3"],
) -> None:
    """Write a point cloud, whole or not at all."""
    rows = np.empty(len(points), LAYOUT)
    for name, column in zip((*NUMBERS, *COLORS), (*points.T, *normals.T, *colors.T), strict=True):
        rows[name] = column
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in NUMBERS] + [f"property uchar {name}" for name in COLORS]
    header += ["end_header"]
    with whole_file(path) as part, part.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode())
        file.write(rows.tobytes())

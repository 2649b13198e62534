"""Point clouds as binary PLY."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from nerf_lightning.export.atomic import whole_file

LAYOUT = np.dtype(
    [
        *((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")),
        *((name, "u1") for name in ("red", "green", "blue")),
    ]
)


def save_points(
    path: Path,
    points: Float[ndarray, "points 3"],
    normals: Float[ndarray, "points 3"],
    colors: UInt8[ndarray, "points 3"],
) -> None:
    """Write a point cloud, whole or not at all."""
    rows = np.empty(len(points), LAYOUT)
    for name, column in zip(LAYOUT.names or (), (*points.T, *normals.T, *colors.T), strict=True):
        rows[name] = column
    kinds = {"<f4": "float", "|u1": "uchar"}
    properties = [f"property {kinds[LAYOUT[name].str]} {name}" for name in LAYOUT.names or ()]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *properties, "end_header"]
    with whole_file(path) as part, part.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode())
        file.write(rows.tobytes())

"""Point clouds as LAS 1.2 (point format 2: places and colours), which programs for surveys read, by laspy."""

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from nerf_lightning.export.mesh_files import require_library
from nerf_lightning.files.atomic import whole_file

# LAS holds places as 32-bit whole numbers; the extent takes from a tenth of this to all of it.
MOST_STEPS = 1e9
# What a cloud of one place at zero gets.
FINEST = 1e-30
# Colours have 16 bits there, full scale: 255 becomes 65535.
COLOR_SCALE = 257


def save_las(path: Path, points: Float[ndarray, "points 3"], colors: UInt8[ndarray, "points 3"]) -> None:
    """Write a point cloud, whole or not at all; LAS has no normals.

    Args:
        path: of the file.
        points: at least one, finite.
        colors: of the points, sRGB.

    Raises:
        InputError: laspy is not installed.
    """
    laspy = require_library("laspy", "las")
    header = laspy.LasHeader(version="1.2", point_format=2)
    header.generating_software = "nerf-lightning"
    header.scales, header.offsets = scale_and_offset(points)
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.red, las.green, las.blue = COLOR_SCALE * colors.T.astype(np.uint16)
    with whole_file(path) as part, part.open("wb") as file:
        las.write(file, do_compress=False)


def scale_and_offset(points: Float[ndarray, "points 3"]) -> tuple[Float[ndarray, "3"], Float[ndarray, "3"]]:
    """Return the step of the whole numbers, one for all axes, and the place that they count from.

    The step is the finest power of ten of which the extent takes at most 1e9, but no finer than what double precision
    tells apart at this distance from zero. The offset is a whole number of steps at or below the least coordinates.

    >>> scale, offset = scale_and_offset(np.array([[-3.0, 0.0, 1.0], [5.0, 2.0, 1.5]]))
    >>> scale.tolist(), offset.tolist()
    ([1e-08, 1e-08, 1e-08], [-3.0, 0.0, 1.0])
    """
    lowest = points.min(axis=0)
    extent, finest = float((points.max(axis=0) - lowest).max()), float(np.spacing(np.abs(points).max()))
    step = 10.0 ** math.ceil(math.log10(max(extent / MOST_STEPS, finest, FINEST)))
    return np.full(3, step), step * np.floor(lowest / step)

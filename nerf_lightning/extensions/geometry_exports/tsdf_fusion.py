"""Fuse depth maps on a grid, on the CPU: the mean of truncated distances (Curless and Levoy, SIGGRAPH 1996).

How much a view's pixel counts: `fused_mesh.py`. Truncation and resolution: `conf/what/mesh.yaml`.
"""

from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit
from numpy import ndarray

from nerf_lightning.nerf.kernels.threads import over_rows

ZERO, HALF, ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)


def add_view(
    distance: Float[ndarray, "x y z"],
    weight: Float[ndarray, "x y z"],
    lower: Float[ndarray, "3"],
    spacing: float,
    camera: Float[ndarray, "16"],
    depth: Float[ndarray, "height width"],
    trust: Float[ndarray, "height width"],
    truncation: float,
) -> None:
    """Add one view to the running means, in place.

    A point at distance r from the eye, whose pixel sees its surface at depth d, is d - r in front of it. Beyond the
    truncation in front of it, space counts as empty; farther behind it, the view knows nothing.

    Args:
        distance: running mean of min((d - r) / truncation, 1) at the points lower + spacing * (i, j, k).
        weight: running sum of the weights.
        lower: of the grid.
        spacing: scene units.
        camera: camera-to-world in row-major order, focal lengths, principal point (pixels); a pinhole.
        depth: distance along each pixel's ray to its surface; inf if there is none.
        trust: each pixel's weight; 0: nothing is known.
        truncation: scene units.
    """
    shape = distance.shape
    rows = (distance.reshape(-1, shape[2]), weight.reshape(-1, shape[2]))
    numbers = tuple(np.float32(number) for number in (*lower, spacing, truncation))
    over_rows(_add, shape[0] * shape[1], *rows, shape[1], numbers, tuple(camera.astype(np.float32)), depth, trust)


@njit(nogil=True, error_model="numpy", cache=True)
@no_type_check
def _add(first, last, distance, weight, across, numbers, camera, depth, trust):
    lower_x, lower_y, lower_z, spacing, truncation = numbers
    ax, bx, cx, ox, ay, by, cy, oy, az, bz, cz, oz, focal_x, focal_y, center_x, center_y = camera
    for row in range(first, last):
        x = lower_x + spacing * np.float32(row // across) - ox
        y = lower_y + spacing * np.float32(row % across) - oy
        for k in range(distance.shape[1]):
            z = lower_z + spacing * np.float32(k) - oz
            ahead = -(x * cx + y * cy + z * cz)
            if ahead <= spacing:
                continue
            column = focal_x * (x * ax + y * ay + z * az) / ahead + center_x
            line = -focal_y * (x * bx + y * by + z * bz) / ahead + center_y
            if not (ZERO <= column < depth.shape[1] and ZERO <= line < depth.shape[0]):
                continue
            sure = trust[int(line), int(column)]
            if sure <= ZERO:
                continue
            before = _depth_at(depth, column, line, truncation) - np.sqrt(x * x + y * y + z * z)
            if before <= -truncation:
                continue
            total = weight[row, k] + sure
            distance[row, k] += (min(before / truncation, ONE) - distance[row, k]) * sure / total
            weight[row, k] = total


@njit(error_model="numpy")
@no_type_check
def _depth_at(depth, column, line, truncation):
    """Interpolate between four pixel centers if they see one surface; else return the nearest pixel's depth."""
    own = depth[int(line), int(column)]
    j = min(max(int(np.floor(column - HALF)), 0), depth.shape[1] - 2)
    i = min(max(int(np.floor(line - HALF)), 0), depth.shape[0] - 2)
    u, v = column - HALF - np.float32(j), line - HALF - np.float32(i)
    a, b, c, d = depth[i, j], depth[i, j + 1], depth[i + 1, j], depth[i + 1, j + 1]
    if not (max(max(a, b), max(c, d)) - min(min(a, b), min(c, d)) < truncation):
        return own
    u, v = min(max(u, ZERO), ONE), min(max(v, ZERO), ONE)
    return (ONE - v) * ((ONE - u) * a + u * b) + v * ((ONE - u) * c + u * d)


def trial() -> None:
    """Run every kernel once on tiny input; errors of the compiler propagate."""
    camera = np.array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 2, 4, 4, 1, 1], np.float32)
    grid, picture = np.zeros((2, 2, 2), np.float32), np.ones((2, 2), np.float32)
    add_view(grid, grid.copy(), camera[:3], 0.1, camera, picture, picture, 0.2)

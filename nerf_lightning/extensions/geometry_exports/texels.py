"""Rasterize triangles into the texels of a picture, on the CPU."""

from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit
from numpy import ndarray


def covered_texels(
    corners: Float[ndarray, "faces 3 2"], size: int
) -> tuple[Int[ndarray, "size size"], Float[ndarray, "size size 3"]]:
    """Return the index of the face that covers each texel's center (-1: none), and its barycentric coordinates there.

    `corners` are x to the right and y down, in texels from the upper left corner of the picture.
    """
    face, shares = np.full((size, size), -1, np.int32), np.zeros((size, size, 3), np.float32)
    _cover(corners.astype(np.float32), face, shares)
    return face, shares


@njit(cache=True, error_model="numpy")
@no_type_check
def _cover(corners, face, shares):
    size = face.shape[0]
    for number in range(corners.shape[0]):
        (ax, ay), (bx, by), (cx, cy) = corners[number, 0], corners[number, 1], corners[number, 2]
        twice_area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if twice_area == 0:
            continue
        left, right = min(ax, min(bx, cx)), max(ax, max(bx, cx))
        top, bottom = min(ay, min(by, cy)), max(ay, max(by, cy))
        for i in range(max(0, int(np.floor(top))), min(size, int(np.ceil(bottom)) + 1)):
            for j in range(max(0, int(np.floor(left))), min(size, int(np.ceil(right)) + 1)):
                x, y = j + np.float32(0.5), i + np.float32(0.5)
                b = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / twice_area
                c = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / twice_area
                a = 1 - b - c
                if a >= 0 and b >= 0 and c >= 0:
                    face[i, j] = number
                    shares[i, j, 0], shares[i, j, 1], shares[i, j, 2] = a, b, c


def trial() -> None:
    """Run every kernel once on tiny input; errors of the compiler propagate."""
    covered_texels(np.array([[[0, 0], [2, 0], [0, 2]]], np.float32), 2)

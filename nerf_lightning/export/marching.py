"""Marching cubes (Lewiner et al. 2003, by scikit-image) block by block, so that memory holds little but the grid."""

from itertools import product

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from nerf_lightning.export.lattice import Report
from nerf_lightning.export.mesh_libraries import require_library

BLOCK = 64
"""Cells along a block's side."""


def marching_cubes(
    density: Float[ndarray, "x y z"], level: float, report: Report, stage: str = "surface", block: int = BLOCK
) -> tuple[Float[ndarray, "vertices 3"], Int[ndarray, "faces 3"]]:
    """Return the surface density = level: vertices in units of cells, and faces, anticlockwise as seen from outside.

    Blocks share the points between them and so the vertices there, bit for bit, which are then made one.
    """
    measure = require_library("skimage.measure")
    corners = list(product(*(range(0, size - 1, block) for size in density.shape)))
    vertices, faces, shared, count = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], [np.zeros(0, bool)], 0
    for number, corner in enumerate(corners):
        part = density[tuple(slice(start, start + block + 1) for start in corner)]
        if part.min() < level < part.max():
            found, triangles, _, _ = measure.marching_cubes(part, level)
            vertices.append(np.array(corner) + found.astype(np.float64))
            # scikit-image's run clockwise where what is dense lies inside.
            faces.append(triangles[:, ::-1].astype(np.int64) + count)
            shared.append(((found == 0) | (found == np.array(part.shape) - 1)).any(axis=1))
            count += len(found)
        report(stage, (number + 1) / len(corners))
    return _joined(np.concatenate(vertices), np.concatenate(faces), np.concatenate(shared))


def _joined(
    vertices: Float[ndarray, "all 3"], faces: Int[ndarray, "faces 3"], shared: ndarray
) -> tuple[Float[ndarray, "vertices 3"], Int[ndarray, "faces 3"]]:
    """Make one of the vertices that several blocks have, and drop the triangles that have no area then."""
    of_one, of_many = np.flatnonzero(~shared), np.flatnonzero(shared)
    once, place = np.unique(vertices[of_many], axis=0, return_inverse=True)
    number = np.empty(len(vertices), np.int64)
    number[of_one] = np.arange(len(of_one))
    number[of_many] = len(of_one) + place.reshape(-1)
    faces = number[faces]
    a, b, c = faces.T
    return np.concatenate([vertices[of_one], once]), faces[(a != b) & (b != c) & (a != c)]

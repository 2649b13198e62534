"""Marching cubes (Lewiner et al. 2003, by scikit-image) block by block, and a mesh without its floaters."""

from itertools import product

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from nerf_lightning.export.density_grid import Report
from nerf_lightning.export.mesh_files import require_library

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
    vertices, faces, shared, count = (
        [np.zeros((0, 3), np.float32)],
        [np.zeros((0, 3), np.int32)],
        [np.zeros(0, bool)],
        0,
    )
    for number, corner in enumerate(corners):
        part = density[tuple(slice(start, start + block + 1) for start in corner)]
        if part.min() < level < part.max():
            found, triangles, _, _ = measure.marching_cubes(part, level)
            vertices.append(np.array(corner, np.float32) + found)
            # scikit-image's run clockwise where what is dense lies inside.
            faces.append(triangles[:, ::-1] + np.int32(count))
            shared.append(((found == 0) | (found == np.array(part.shape) - 1)).any(axis=1))
            count += len(found)
        report(stage, (number + 1) / len(corners))
    return _joined(*(_emptied(parts) for parts in (vertices, faces, shared)))


def _joined(
    vertices: Float[ndarray, "all 3"], faces: Int[ndarray, "faces 3"], shared: ndarray
) -> tuple[Float[ndarray, "vertices 3"], Int[ndarray, "faces 3"]]:
    """Make one of the vertices that several blocks have, and drop the triangles that have no area then."""
    of_one, of_many = np.flatnonzero(~shared), np.flatnonzero(shared)
    once, place = np.unique(vertices[of_many], axis=0, return_inverse=True)
    number = np.empty(len(vertices), np.int32)
    number[of_one] = np.arange(len(of_one))
    number[of_many] = len(of_one) + place.reshape(-1)
    faces = number[faces]
    a, b, c = faces.T
    return np.concatenate([vertices[of_one], once]), faces[(a != b) & (b != c) & (a != c)]


def _emptied(parts: list[ndarray]) -> ndarray:
    # The parts would otherwise lie in memory beside the whole.
    whole = np.concatenate(parts)
    parts.clear()
    return whole


def without_floaters(
    vertices: Float[ndarray, "vertices 3"], faces: Int[ndarray, "faces 3"], least_share: float
) -> tuple[Float[ndarray, "kept 3"], Int[ndarray, "kept_faces 3"], int]:
    """Return the connected parts that have at least this share of the largest one's faces, and how many have not."""
    graph, sparse = require_library("scipy.sparse.csgraph"), require_library("scipy.sparse")
    size = len(vertices)
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    links = sparse.coo_array((np.ones(len(edges), bool), edges.T), shape=(size, size))
    _, part_of_vertex = graph.connected_components(links, directed=False)
    part = part_of_vertex[faces[:, 0]]
    num_faces = np.bincount(part)
    large = num_faces >= least_share * num_faces.max()
    faces = faces[large[part]]
    used = np.unique(faces)
    place = np.full(size, -1, np.int32)
    place[used] = np.arange(len(used))
    return vertices[used], place[faces], int(((num_faces > 0) & ~large).sum())

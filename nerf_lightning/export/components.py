"""Floaters: parts of a mesh that hang together with nothing else."""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from nerf_lightning.export.mesh_libraries import require_library


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
    place = np.full(size, -1, np.int64)
    place[used] = np.arange(len(used))
    return vertices[used], place[faces], int(((num_faces > 0) & ~large).sum())

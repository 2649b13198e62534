"""The surface where the density crosses a level, as a mesh: closed, including the insides of objects.

Marching cubes (Lewiner et al. 2003) are scikit-image's; floaters are removed.

The level is `threshold` in conf/what/mesh.yaml, or else chosen by `surface.py`.
"""

import logging

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from nerf_lightning.export.base import Report
from nerf_lightning.export.visibility import num_agreeing, see
from nerf_lightning.extensions.geometry_exports.density_grid import Lattice, sample_density
from nerf_lightning.extensions.geometry_exports.mesh_files import require_library
from nerf_lightning.extensions.geometry_exports.surface import surface_level
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import at_most
from nerf_lightning.nerf.geometry.clipping import CropBox
from nerf_lightning.nerf.geometry.subset import evenly_spaced_subset
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.types.scene import SceneRecord

BYTES_PER_POINT = 8  # The density's grid, and as much again for the mesh.
RATIO = 10.0  # This many times the surface's density counts as solid, and 1 / RATIO of it as empty.

log = logging.getLogger(__name__)


def mesh_of_density(
    model: Model,
    record: SceneRecord,
    lattice: Lattice,
    threshold: float | None,
    closed: bool,
    tile_points: int,
    report: Report,
) -> tuple[Float[ndarray, "vertices 3"], Int[ndarray, "faces 3"]]:
    """Return vertices (scene frame) and faces of the surface where the density is `threshold` per scene unit.

    Without a threshold, the surface is where rendering sees it (`surface_level`). `closed`: also at the sides of the
    box.
    """
    density = sample_density(model, lattice, tile_points, report)
    if closed or record.space == "bounded":  # Nothing is outside a bounded scene.
        for axis in range(3):
            sides = np.moveaxis(density, axis, 0)
            sides[0] = sides[-1] = 0.0
    level = _level(model, record, density, threshold, tile_points)
    # Densities grow exponentially, so the logarithm of their ratio to the level is linear.
    density /= level
    np.clip(density, 1.0 / RATIO, RATIO, out=density)
    np.log(density, out=density)
    vertices, faces = marching_cubes(density, 0.0, report)
    log.info("the surface is where the density is %.4g", level)
    return lattice.to_scene(vertices), faces


def _level(
    model: Model, record: SceneRecord, density: Float[ndarray, "x y z"], threshold: float | None, tile_points: int
) -> float:
    level = threshold or surface_level(model, record, tile_points)
    lowest, highest = float(density.min()), float(density.max())
    if level is not None and lowest < level < highest:
        return level
    found = f"the densities in its box range from {lowest:.3g} to {highest:.3g} per scene unit"
    if level is None:
        missing, seen = "", ", and no training view sees anything opaque there"
    else:
        missing, seen = f" where the density is {level:.3g}", ""
    raise InputError(
        f"There is no surface in {record.name}{missing}: {found}{seen}. Train longer, or give what.threshold=DENSITY "
        "between the two."
    )


def marching_cubes(
    density: Float[ndarray, "x y z"], level: float, report: Report
) -> tuple[Float[ndarray, "vertices 3"], Int[ndarray, "faces 3"]]:
    """Return the surface density = level: vertices in units of cells, and faces, counterclockwise from outside."""
    measure = require_library("skimage.measure")
    if not density.min() < level < density.max():
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
    vertices, faces, _, _ = measure.marching_cubes(density, level)
    report("surface", 1.0)
    # scikit-image's are clockwise if the inside is dense.
    return vertices, np.ascontiguousarray(faces[:, ::-1])


def without_floaters(
    vertices: Float[ndarray, "vertices 3"], faces: Int[ndarray, "faces 3"], least_share: float
) -> tuple[Float[ndarray, "kept 3"], Int[ndarray, "kept_faces 3"], int]:
    """Return the connected parts with at least this share of the largest one's faces, and the number of others."""
    part = _part_of_face(len(vertices), faces)
    num_faces = np.bincount(part)
    large = num_faces >= least_share * num_faces.max()
    return *_only(vertices, faces[large[part]]), int(((num_faces > 0) & ~large).sum())


def without_cavities(
    vertices: Float[ndarray, "vertices 3"], faces: Int[ndarray, "faces 3"]
) -> tuple[Float[ndarray, "kept 3"], Int[ndarray, "kept_faces 3"]]:
    """Return the connected parts of a closed mesh that enclose matter: the surface of a cavity has negative volume."""
    a, b, c = vertices[faces.T].astype(np.float64)
    volumes = (a * np.cross(b, c)).sum(axis=1) / 6.0
    part = _part_of_face(len(vertices), faces)
    return _only(vertices, faces[(np.bincount(part, volumes) > 0)[part]])


def in_box(
    vertices: Float[ndarray, "vertices 3"], faces: Int[ndarray, "faces 3"], box: CropBox
) -> tuple[Float[ndarray, "kept 3"], Int[ndarray, "kept_faces 3"]]:
    """Return the faces with all corners in a crop box.

    Raises:
        InputError: there is none.
    """
    inside = box.holds(torch.from_numpy(vertices)).numpy()
    faces = faces[inside[faces].all(axis=1)]
    if not len(faces):
        raise InputError("crop: there is no surface in this box. Its corners are in the capture's own frame.")
    return _only(vertices, faces)


def _part_of_face(size: int, faces: Int[ndarray, "faces 3"]) -> Int[ndarray, "faces"]:
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    links = coo_array((np.ones(len(edges), bool), edges.T), shape=(size, size))
    found: Int[ndarray, "faces"] = connected_components(links, directed=False)[1][faces[:, 0]]
    return found


def _only(
    vertices: Float[ndarray, "vertices 3"], faces: Int[ndarray, "faces 3"]
) -> tuple[Float[ndarray, "kept 3"], Int[ndarray, "faces 3"]]:
    used = np.unique(faces)
    place = np.full(len(vertices), -1, np.int32)
    place[used] = np.arange(len(used))
    return vertices[used], place[faces]


VIEWS, LONGEST = 60, 400  # Training views that are rendered, and their longer side in pixels.
TOLERANCE = 0.015  # A vertex is visible if a view's depth equals its distance, up to this share of it.
RINGS = 2  # Rings of faces that are added around visible ones, to avoid holes at grazing angles and thin parts.


def seen_faces(
    model: Model,
    record: SceneRecord,
    vertices: Float[ndarray, "vertices 3"],
    faces: Int[ndarray, "faces 3"],
    min_opacity: float,
    tile_points: int,
    report: Report,
) -> Int[ndarray, "seen 3"]:
    """Return the faces that a training view sees, and their neighbors; refuse a mesh without any."""
    cameras, views = at_most(record.cameras, LONGEST), evenly_spaced_subset(record.splits["train"], VIEWS)
    points = torch.from_numpy(vertices).float()
    seen = torch.zeros(len(points), dtype=torch.bool)
    for number, view in enumerate(views):
        depth = see(model, record, cameras, view, tile_points).surface_depth(min_opacity)
        seen |= num_agreeing(points, cameras, {view: depth}, [view], TOLERANCE) > 0
        report("views", (number + 1) / len(views))
    known = seen.numpy()
    kept = known[faces].any(axis=1)
    for _ in range(RINGS):
        known[faces[kept]] = True
        kept = known[faces].any(axis=1)
    if not kept.any():
        raise InputError(
            "No training view sees any part of the mesh as its surface: what.threshold is far from the density that "
            "the views end in. Give another, what.threshold=null, or what.seen_only=false."
        )
    return np.ascontiguousarray(faces[kept])

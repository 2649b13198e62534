"""A mesh of the surface: of the density or of what the views see, cleaned, coloured, in the user's frame."""

import logging
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from nerf_lightning.console import StageProgress
from nerf_lightning.errors import InputError
from nerf_lightning.export import density_mesh, fused_mesh
from nerf_lightning.export.base import Export, refuse_ndc
from nerf_lightning.export.density_grid import Lattice, Report, require_resolution
from nerf_lightning.export.density_mesh import mesh_of_density
from nerf_lightning.export.fused_mesh import mesh_of_depth
from nerf_lightning.export.marching_cubes import without_floaters
from nerf_lightning.export.mesh_files import MeshFormat, require_library, save_mesh
from nerf_lightning.export.surface import SeenFrom, surface_colors
from nerf_lightning.export.visibility import seen_faces
from nerf_lightning.nerf.geometry.frames import directions_to_user, points_to_user
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.types.scene import SceneRecord

Surface = Literal["density", "tsdf"]
BYTES_PER_POINT = {"density": density_mesh.BYTES_PER_POINT, "tsdf": fused_mesh.BYTES_PER_POINT}
# A guess at how the time is shared; the bar corrects itself.
COSTS = {
    "density": {"density": 6.0, "surface": 2.0, "views": 6.0, "colours": 4.0},
    "tsdf": {"depth": 12.0, "surface": 2.0, "colours": 4.0},
}

log = logging.getLogger(__name__)


class MeshExport(Export):
    """Write `mesh.ply` (or .obj, .glb) of what lies in the scene's box.

    Args:
        resolution: cells along the longest side of the box.
        surface: `density` is where the density crosses the threshold, also where nobody looks; `tsdf` fuses the
            rendered depth of the training views, which is nearer to what they see, and open where none looks.
        threshold: with `density`: per scene unit, at the surface; None: where rendering sees it (`surface_level`).
        truncation: with `tsdf`: how far before and behind a surface views are asked for their distance, in cells. More
            is smoother, less keeps thin things.
        colors: colour of a vertex, as seen from the nearest cameras, or along the surface's normal.
        min_share: connected parts with fewer faces than this share of the largest one's are floaters, and removed.
        seen_only: remove what no training view sees, the insides of things above all; else the mesh is closed.
        faces: most faces, reached by decimation; None keeps all.
        format: of the file; PLY and OBJ open everywhere, in the capture's frame; GLB is one file for browsers, and its
            root node turns it so that y is up, as glTF has it.
    """

    def __init__(
        self,
        resolution: int = 256,
        surface: Surface = "density",
        threshold: float | None = None,
        truncation: float = 4.0,
        colors: SeenFrom = "cameras",
        min_share: float = 0.01,
        seen_only: bool = True,
        faces: int | None = None,
        format: MeshFormat = "ply",
    ):
        if threshold is not None and not threshold > 0:
            raise InputError(f"what.threshold={threshold}: give a density above 0, or null to take it from the data.")
        if not 1 <= truncation <= 64:
            raise InputError(f"what.truncation={truncation}: give a number of cells from 1 to 64.")
        if surface == "tsdf" and threshold is not None:
            raise InputError(
                f"what.threshold={threshold} belongs to what.surface=density: with what.surface=tsdf the surface is "
                "where the views' light is stopped. Leave one of the two out."
            )
        if surface == "tsdf" and not seen_only:
            raise InputError(
                "what.seen_only=false asks for a closed mesh, and what.surface=tsdf knows only what the views see. "
                "Take what.surface=density for it."
            )
        if not 0 <= min_share <= 1:
            raise InputError(f"what.min_share={min_share}: give a share from 0 (all is kept) to 1 (the largest part).")
        if faces is not None and faces < 4:
            raise InputError(f"what.faces={faces}: a closed mesh has 4 or more; null keeps all.")
        self.resolution, self.colors = resolution, colors
        self.surface, self.threshold, self.truncation = surface, threshold, truncation
        self.min_share, self.seen_only, self.faces, self.format = min_share, seen_only, faces, format

    def export(self, model: Model, record: SceneRecord, folder: Path, tile_points: int) -> list[Path]:
        """Write the mesh."""
        refuse_ndc(record, "mesh")
        require_library("trimesh")  # before the work, not after it
        lattice = require_resolution(record, self.resolution, BYTES_PER_POINT[self.surface])
        with StageProgress(COSTS[self.surface]) as report:
            vertices, faces = self._surface(model, record, lattice, tile_points, report)
            vertices, faces = self._cleaned(vertices, faces)
            normals = vertex_normals(vertices, faces)
            points, outward = torch.from_numpy(vertices), torch.from_numpy(normals)
            # Two cells to each side: so far the surface may be off.
            reach = 2.0 * lattice.spacing
            colors = surface_colors(model, record, points, outward, reach, self.colors, tile_points, report)
        path, to_user = folder / f"mesh.{self.format}", record.to_user.double()
        placed, turned = points_to_user(points.double(), to_user), directions_to_user(outward.double(), to_user)
        up = directions_to_user(torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64), to_user)[0]
        save_mesh(path, placed.numpy(), faces, turned.numpy(), colors.numpy(), up.numpy())
        log.info("%d vertices, %d faces", len(vertices), len(faces))
        return [path]

    def _surface(
        self, model: Model, record: SceneRecord, lattice: Lattice, tile_points: int, report: Report
    ) -> tuple[Float[ndarray, "vertices 3"], Int[ndarray, "faces 3"]]:
        if self.surface == "tsdf":
            return mesh_of_depth(model, record, lattice, self.truncation, tile_points, report)
        vertices, faces = mesh_of_density(model, record, lattice, self.threshold, tile_points, report)
        if self.seen_only:
            faces = seen_faces(model, record, vertices, faces, tile_points, report)
        return vertices, faces

    def _cleaned(
        self, vertices: Float[ndarray, "vertices 3"], faces: Int[ndarray, "faces 3"]
    ) -> tuple[Float[ndarray, "kept 3"], Int[ndarray, "kept_faces 3"]]:
        vertices, faces, removed = without_floaters(vertices, faces, self.min_share)
        if removed:
            log.info("%d floaters removed, each below %g of the largest part", removed, self.min_share)
        if self.faces is None or len(faces) <= self.faces:
            return vertices, faces
        decimation = require_library("fast_simplification")
        few, kept = decimation.simplify(vertices, faces, target_count=self.faces)
        return np.asarray(few, np.float32), np.asarray(kept, np.int32)


def vertex_normals(
    vertices: Float[ndarray, "vertices 3"], faces: Int[ndarray, "faces 3"]
) -> Float[ndarray, "vertices 3"]:
    """Return the mean normal of the faces around each vertex, by their areas, of unit length.

    >>> vertex_normals(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]]))[0].round(4).tolist()
    [0.5774000287055969, 0.5774000287055969, 0.5774000287055969]
    """
    a, b, c = (vertices[corner] for corner in faces.T)
    twice_area = np.cross(b - a, c - a)
    normals = np.empty_like(vertices)
    for axis, part in enumerate(twice_area.T):
        normals[:, axis] = sum(np.bincount(corner, part, len(vertices)) for corner in faces.T)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float32).tiny)

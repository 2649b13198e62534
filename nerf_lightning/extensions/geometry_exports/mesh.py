"""A mesh of the surface, from the density or from what the views see, cleaned, colored, in the user's frame.

Its numbers: `conf/what/mesh.yaml`. Which parts are left out as floaters: `without_floaters` in `density_mesh.py`.
"""

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from nerf_lightning.export.base import (
    MODEL_ALONE,
    Export,
    Report,
    RunContext,
    refuse_ndc,
    require_free,
    require_setting,
)
from nerf_lightning.extensions.geometry_exports import density_mesh, fused_mesh
from nerf_lightning.extensions.geometry_exports.density_grid import Lattice, require_resolution
from nerf_lightning.extensions.geometry_exports.density_mesh import (
    in_box,
    mesh_of_density,
    seen_faces,
    without_cavities,
    without_floaters,
)
from nerf_lightning.extensions.geometry_exports.fused_mesh import mesh_of_depth
from nerf_lightning.extensions.geometry_exports.mesh_files import (
    GltfFrame,
    MeshFormat,
    require_library,
    save_mesh,
    save_solid,
    save_textured_mesh,
)
from nerf_lightning.extensions.geometry_exports.surface import SeenFrom, surface_colors
from nerf_lightning.extensions.geometry_exports.texture import (
    LARGEST_SIZE,
    LEAST_SIZE,
    TextureMaker,
    find_texels,
    make_atlas,
    require_texture_room,
)
from nerf_lightning.files.made_folders import child_of
from nerf_lightning.messages.console import StageProgress
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.world_frame import directions_to_user, points_to_user, unit_of
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.types.scene import SceneRecord

Surface = Literal["density", "tsdf"]
BYTES_PER_POINT = {"density": density_mesh.BYTES_PER_POINT, "tsdf": fused_mesh.BYTES_PER_POINT}
# Estimated shares of the time; the bar corrects itself.
COSTS = {"density": {"density": 6.0, "surface": 2.0, "views": 6.0}, "tsdf": {"depth": 12.0, "surface": 2.0}}
COLORING = {False: {"colors": 4.0}, True: {"charts": 6.0, "sight": 4.0, "texels": 40.0}}
UNKNOWN = 100.0  # Millimeters: the longest side of a print of unknown size.
REACH = 2.0  # Maximum error of the surface to each side, in cells.
# Default maximum number of faces of a textured mesh: charts of more take minutes.
TEXTURED_FACES = 60_000

log = logging.getLogger(__name__)


@dataclass
class MeshExport(Export):
    """Write `mesh.ply` (or .obj, .glb, .stl) of the content of the scene's box, with a color per vertex or a texture.

    Args:
        resolution: cells along the longest side of the box.
        surface: `density` extracts the surface where the density crosses the threshold; `tsdf` fuses the rendered
            depth of the training views, which is closer to the true surface, and open where no view looks.
        threshold: with `density`: the density at the surface, per scene unit; None: where rendering sees it
            (`surface_level`).
        truncation: with `tsdf`: the distance in front of and behind a surface within which views are averaged, in
            cells. Larger values are smoother; smaller ones keep thin parts.
        colors: the color of a vertex: as seen from the nearest cameras, or along the surface's normal.
        min_share: connected parts with fewer faces than this share of the largest one are removed as floaters.
        seen_only: remove what no training view sees, mainly interior surfaces; otherwise the mesh is closed.
        faces: maximum number of faces, by decimation; None: all, or 60,000 with a texture.
        texture: write a texture, with each texel from the views that face it most directly; `colors` is then ignored.
            Needs `pip install '.[texture]'`.
        texture_size: texels along each side of the texture.
        format: the file format. PLY and OBJ use the capture's frame; GLB is one file for browsers, whose root node
            makes y up and, if the capture's unit is known, a unit one meter, as glTF requires. STL is for 3D printing:
            a closed mesh without cavities and colors, z up, in millimeters. None: PLY, or GLB with a texture; a
            textured OBJ comes with an MTL and a PNG.
    """

    crops = True
    kernels = (f"{__package__}.tsdf_fusion", f"{__package__}.texels")

    resolution: int = 256
    surface: Surface = "density"
    threshold: float | None = None
    truncation: float = 4.0
    colors: SeenFrom = "cameras"
    min_share: float = 0.01
    seen_only: bool = True
    faces: int | None = None
    texture: bool = False
    texture_size: int = 2048
    format: MeshFormat | None = None

    def __post_init__(self) -> None:
        positive = self.threshold is None or self.threshold > 0
        require_setting("threshold", self.threshold, positive, "give a density above 0, or null to find it.")
        cells = 1 <= self.truncation <= 64
        require_setting("truncation", self.truncation, cells, "give a number of cells from 1 to 64.")
        share = 0 <= self.min_share <= 1
        require_setting("min_share", self.min_share, share, "give a share from 0 (all) to 1 (the largest part).")
        enough = self.faces is None or self.faces >= 4
        require_setting("faces", self.faces, enough, "a closed mesh has 4 or more; null keeps all.")
        sizes = f"give a number of texels from {LEAST_SIZE} to {LARGEST_SIZE}."
        fits = LEAST_SIZE <= self.texture_size <= LARGEST_SIZE
        require_setting("texture_size", self.texture_size, fits, sizes)
        if self.surface == "tsdf" and self.threshold is not None:
            raise InputError(f"what.threshold={self.threshold} belongs to what.surface=density. Leave one of them out.")
        if self.surface == "tsdf" and not self.seen_only:
            raise InputError("what.seen_only=false asks for a closed mesh, which needs what.surface=density.")
        if self.texture and self.format in ("ply", "stl"):
            raise InputError(
                f"what.format={self.format} has no texture. Give what.format=glb (one file), or obj (three)."
            )
        if self.format == "stl" and self.surface == "tsdf":
            raise InputError("what.format=stl asks for a closed mesh, which needs what.surface=density.")
        self.seen_only = self.seen_only and self.format != "stl"
        if self.texture and self.faces is None:
            self.faces = TEXTURED_FACES
        self.format = self.format or ("glb" if self.texture else "ply")

    def export(
        self, model: Model, record: SceneRecord, folder: Path, tile_points: int, run: RunContext = MODEL_ALONE
    ) -> list[Path]:
        """Write the mesh."""
        refuse_ndc(record, "mesh")
        if run.crop is not None and self.format == "stl":
            raise InputError("what.format=stl asks for a closed mesh, which a crop box opens. Leave one of them out.")
        beside = ("mtl", "png") if self.texture and self.format == "obj" else ()
        require_free(child_of(folder, f"mesh.{ending}") for ending in (self.format, *beside))
        require_library("trimesh")  # before the work, not after it
        lattice = require_resolution(record, self.resolution, BYTES_PER_POINT[self.surface])
        if self.texture:
            require_library("xatlas", "texture")
            require_texture_room(self.texture_size)
        with StageProgress(COSTS[self.surface] | COLORING[self.texture]) as report:
            vertices, faces = self._surface(model, record, lattice, run.min_opacity, tile_points, report)
            if run.crop is not None:
                vertices, faces = in_box(vertices, faces, run.crop)
            vertices, faces = self._cleaned(vertices, faces)
            if self.format == "stl":
                return save_solid(folder / "mesh.stl", in_millimeters(vertices, record), faces)
            log.info("%d vertices, %d faces", len(vertices), len(faces))
            points, normals = torch.from_numpy(vertices), torch.from_numpy(vertex_normals(vertices, faces))
            reach = REACH * lattice.spacing
            if not self.texture:
                colors = surface_colors(model, record, points, normals, reach, self.colors, tile_points, report)
                return self._save(record, folder, points, faces, normals, colors=colors.numpy())
            atlas = make_atlas(vertices, faces, self.texture_size)
            report("charts", 1.0)
            maker = TextureMaker(model, record, points, normals, reach, tile_points)
            picture = maker(find_texels(atlas, self.texture_size), self.texture_size, report)
        source = torch.from_numpy(atlas.source)
        return self._save(record, folder, points[source], atlas.faces, normals[source], uv=atlas.uv, picture=picture)

    def _save(
        self,
        record: SceneRecord,
        folder: Path,
        points: Float[Tensor, "vertices 3"],
        faces: Int[ndarray, "faces 3"],
        normals: Float[Tensor, "vertices 3"],
        **appearance: ndarray,
    ) -> list[Path]:
        """Write a mesh in the scene's frame to files in the user's frame."""
        to_user = record.to_user.double()
        up = directions_to_user(torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64), to_user)[0]
        placed, turned = points_to_user(points.double(), to_user), directions_to_user(normals.double(), to_user)
        frame = GltfFrame(up.numpy(), record.metres_per_unit or 1.0)
        save = save_textured_mesh if self.texture else save_mesh
        return save(
            child_of(folder, f"mesh.{self.format}"), placed.numpy(), faces, turned.numpy(), frame=frame, **appearance
        )

    def _surface(
        self,
        model: Model,
        record: SceneRecord,
        lattice: Lattice,
        min_opacity: float,
        tile_points: int,
        report: Report,
    ) -> tuple[Float[ndarray, "vertices 3"], Int[ndarray, "faces 3"]]:
        if self.surface == "tsdf":
            return mesh_of_depth(model, record, lattice, self.truncation, min_opacity, tile_points, report)
        closed = self.format == "stl"
        vertices, faces = mesh_of_density(model, record, lattice, self.threshold, closed, tile_points, report)
        if closed:
            vertices, faces = without_cavities(vertices, faces)
        if self.seen_only:
            faces = seen_faces(model, record, vertices, faces, min_opacity, tile_points, report)
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


def in_millimeters(vertices: Float[ndarray, "vertices 3"], record: SceneRecord) -> Float[ndarray, "vertices 3"]:
    """Return vertices of the scene's frame, whose z is up, in millimeters and above z = 0, as printers require.

    If the capture's unit is unknown, the longest side becomes 100 mm long.
    """
    scale = 1e3 * unit_of(record.to_user) * (record.metres_per_unit or 0.0)
    if not scale:
        scale = UNKNOWN / float(np.ptp(vertices, axis=0).max())
        log.warning(
            "The size is not known, so the longest side is %g mm: scale it in the slicer, or train with "
            "scene.metres_per_unit.",
            UNKNOWN,
        )
    scaled = scale * vertices
    return scaled - [0.0, 0.0, scaled[:, 2].min()]


def vertex_normals(
    vertices: Float[ndarray, "vertices 3"], faces: Int[ndarray, "faces 3"]
) -> Float[ndarray, "vertices 3"]:
    """Return the unit mean normal of the faces around each vertex, weighted by area.

    >>> vertex_normals(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]]))[0].round(4).tolist()
    [0.5774000287055969, 0.5774000287055969, 0.5774000287055969]
    """
    a, b, c = (vertices[corner] for corner in faces.T)
    twice_area = np.cross(b - a, c - a)
    normals = np.empty_like(vertices)
    for axis, part in enumerate(twice_area.T):
        normals[:, axis] = sum(np.bincount(corner, part, len(vertices)) for corner in faces.T)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float32).tiny)

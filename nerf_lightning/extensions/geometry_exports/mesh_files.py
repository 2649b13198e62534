"""Mesh files: PLY, OBJ and GLB, with normals and colors of vertices or with a texture, by optional libraries."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from PIL import Image

from nerf_lightning.files.atomic import whole_file
from nerf_lightning.files.made_folders import child_of
from nerf_lightning.messages.errors import InputError, require_extra
from nerf_lightning.nerf.geometry.world_frame import y_up
from nerf_lightning.nerf.rendering.linear_light import to_linear

MeshFormat = Literal["ply", "obj", "glb", "stl"]
MADE_BY = {"mesh": "a mesh", "texture": "a mesh with a texture", "las": "points as LAS"}
"""What each extra of this package is needed for."""


COLORS = "_COLORS"
"""An attribute of vertices for trimesh, whose own colors have 8 bits: too few for dark colors in linear light."""


@dataclass(frozen=True)
class GltfFrame:
    """The conversion to glTF, where y is up and a unit is a meter: the root node rotates and scales the frame.

    PLY and OBJ define neither up nor units, and keep the frame.
    """

    up: Float[ndarray, "3"]
    """The unit vector that points up, in the frame of the vertices."""
    metres: float
    """Length of a unit of that frame in meters; 1 if unknown."""

    def __call__(self, tree: dict[str, Any]) -> None:
        """Set the root node's transform, name the colors, and disable lighting in viewers: the colors include it."""
        (root,) = tree["scenes"][tree["scene"]]["nodes"]
        placed = np.diag([self.metres, self.metres, self.metres, 1.0]) @ y_up(torch.from_numpy(self.up)).numpy()
        tree["nodes"][root]["matrix"] = placed.T.flatten().tolist()  # in column-major order
        tree["extensionsUsed"] = ["KHR_materials_unlit"]
        rough = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
        tree.setdefault("materials", [{"pbrMetallicRoughness": rough}])[0]["extensions"] = {"KHR_materials_unlit": {}}
        for primitive in (each for mesh in tree["meshes"] for each in mesh["primitives"]):
            primitive["material"] = 0
            attributes = primitive["attributes"]
            if COLORS in attributes:
                attributes["COLOR_0"] = attributes.pop(COLORS)
                tree["accessors"][attributes["COLOR_0"]]["normalized"] = True


def save_mesh(
    path: Path,
    vertices: Float[ndarray, "vertices 3"],
    faces: Int[ndarray, "faces 3"],
    normals: Float[ndarray, "vertices 3"],
    frame: GltfFrame,
    colors: UInt8[ndarray, "vertices 3"],
) -> list[Path]:
    """Write a mesh with an sRGB color per vertex atomically; the extension determines the format."""
    trimesh = require_library("trimesh")
    form = path.suffix[1:]
    look: dict[str, Any] = {"vertex_colors": colors}
    if form == "glb":  # glTF interprets vertex colors as linear light
        linear = to_linear(torch.from_numpy(np.insert(colors, 3, 255, axis=1) / 255.0)).numpy()
        look = {"vertex_attributes": {COLORS: np.rint(65535.0 * linear).astype(np.uint16)}}
    mesh = trimesh.Trimesh(vertices, faces, vertex_normals=normals, process=False, **look)
    settings: dict[str, dict[str, Any]] = {
        "ply": {"vertex_normal": True},
        "obj": {"include_normals": True, "header": None},
        "glb": {"include_normals": True, "tree_postprocessor": frame},
    }
    content = mesh.export(file_type=form, **settings[form])
    with whole_file(path) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)
    return [path]


def save_solid(path: Path, vertices: Float[ndarray, "vertices 3"], faces: Int[ndarray, "faces 3"]) -> list[Path]:
    """Write a binary STL for printers, which has neither colors nor units; slicers read millimeters.

    Raises:
        InputError: the mesh is not closed.
    """
    mesh = require_library("trimesh").Trimesh(vertices, faces, process=False)
    if not mesh.is_watertight:
        raise InputError("The mesh is not closed, as printing needs it. Give more what.faces, or leave them out.")
    with whole_file(path) as part:
        part.write_bytes(mesh.export(file_type="stl"))
    return [path]


def save_textured_mesh(
    path: Path,
    vertices: Float[ndarray, "vertices 3"],
    faces: Int[ndarray, "faces 3"],
    normals: Float[ndarray, "vertices 3"],
    frame: GltfFrame,
    uv: Float[ndarray, "vertices 2"],
    picture: UInt8[ndarray, "height width 3"],
) -> list[Path]:
    """Write a textured mesh as GLB, or as OBJ with its MTL and PNG next to it, and return the files.

    Each is written atomically; the OBJ, which names the others, comes last. `uv` is the place of each vertex in the
    picture (sRGB), from 0 to 1, to the right and up.
    """
    trimesh = require_library("trimesh")
    image, visual = Image.fromarray(picture), trimesh.visual
    form = path.suffix[1:]
    if form == "glb":
        material = visual.material.PBRMaterial(baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0)
    else:
        # Full ambient and diffuse light and no highlights: the light is already in the colors.
        material = visual.material.SimpleMaterial(image, ambient=[1.0] * 3, diffuse=[1.0] * 3, specular=[0.0] * 3)
        material.name = path.stem
    textured = visual.TextureVisuals(uv=uv, material=material)
    mesh = trimesh.Trimesh(vertices, faces, vertex_normals=normals, visual=textured, process=False)
    if form == "glb":
        contents = {path: mesh.export(file_type=form, include_normals=True, tree_postprocessor=frame)}
    else:
        exchange = require_library("trimesh.exchange.obj")
        settings = {"include_normals": True, "return_texture": True, "header": None}
        text, beside = exchange.export_obj(mesh, mtl_name=path.with_suffix(".mtl").name, **settings)
        contents = {child_of(path.parent, name): content for name, content in beside.items()} | {path: text.encode()}
    for each, content in contents.items():
        with whole_file(each) as part:
            part.write_bytes(content)
    return list(contents)


def require_library(name: str, extra: str = "mesh") -> Any:
    """Return a module of an extra, or report how to install it."""
    return require_extra(name, extra, f"Exporting {MADE_BY[extra]}")

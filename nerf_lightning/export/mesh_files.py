"""Mesh files: PLY, OBJ and GLB, with a normal and a colour for each vertex or with a texture, by optional libraries."""

from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from PIL import Image

from nerf_lightning.errors import InputError
from nerf_lightning.files.atomic import whole_file
from nerf_lightning.nerf.geometry.frames import upright_rotation

MeshFormat = Literal["ply", "obj", "glb"]
MADE_BY = {"mesh": "a mesh", "texture": "a mesh with a texture", "las": "points as LAS"}
"""What each extra of this package is needed for."""


def save_mesh(
    path: Path,
    vertices: Float[ndarray, "vertices 3"],
    faces: Int[ndarray, "faces 3"],
    normals: Float[ndarray, "vertices 3"],
    colors: UInt8[ndarray, "vertices 3"],
    up: Float[ndarray, "3"],
    metres: float,
) -> None:
    """Write a mesh, whole or not at all; the ending says in which format.

    PLY and OBJ say nothing of up and of units, and keep the frame. In glTF, y is up and a unit is a metre: there the
    vertices keep the frame too, and the root node turns and scales it.

    Args:
        path: of the file.
        vertices: where the corners are.
        faces: three corners each.
        normals: of the corners.
        colors: of the corners, sRGB.
        up: the unit vector that points up, in the frame of the vertices.
        metres: how long a unit of that frame is; where nobody knows, 1.
    """
    trimesh = require_library("trimesh")
    form = path.suffix[1:]
    shown = _linear(colors) if form == "glb" else colors
    mesh = trimesh.Trimesh(vertices, faces, vertex_normals=normals, vertex_colors=shown, process=False)
    settings: dict[str, dict[str, Any]] = {
        "ply": {"vertex_normal": True},
        "obj": {"include_normals": True, "header": None},
        "glb": {"include_normals": True, "tree_postprocessor": partial(_as_gltf, up, metres)},
    }
    content = mesh.export(file_type=form, **settings[form])
    with whole_file(path) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)


def save_textured_mesh(
    path: Path,
    vertices: Float[ndarray, "vertices 3"],
    faces: Int[ndarray, "faces 3"],
    normals: Float[ndarray, "vertices 3"],
    uv: Float[ndarray, "vertices 2"],
    picture: UInt8[ndarray, "height width 3"],
    up: Float[ndarray, "3"],
    metres: float,
) -> list[Path]:
    """Write a mesh with a texture as GLB, or as OBJ with its MTL and PNG beside it, and return the files.

    Each is whole or not there; the OBJ, which names the others, comes last.

    Args:
        path: of the file; its ending says in which format.
        vertices: where the corners are.
        faces: three corners each.
        normals: of the corners.
        uv: where each corner lies in the picture, from 0 to 1, to the right and up.
        picture: sRGB.
        up: the unit vector that points up, in the frame of the vertices.
        metres: how long a unit of that frame is; where nobody knows, 1.
    """
    trimesh = require_library("trimesh")
    image, visual = Image.fromarray(picture), trimesh.visual
    form = path.suffix[1:]
    if form == "glb":
        material = visual.material.PBRMaterial(baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0)
    else:
        # Full ambient and diffuse light and no highlights: the light is in the colours already.
        material = visual.material.SimpleMaterial(image, ambient=[1.0] * 3, diffuse=[1.0] * 3, specular=[0.0] * 3)
        material.name = path.stem
    textured = visual.TextureVisuals(uv=uv, material=material)
    mesh = trimesh.Trimesh(vertices, faces, vertex_normals=normals, visual=textured, process=False)
    if form == "glb":
        contents = {
            path: mesh.export(file_type=form, include_normals=True, tree_postprocessor=partial(_as_gltf, up, metres))
        }
    else:
        exchange = require_library("trimesh.exchange.obj")
        mtl = path.with_suffix(".mtl")
        settings = {"include_normals": True, "return_texture": True, "mtl_name": mtl.name, "header": None}
        text, beside = exchange.export_obj(mesh, **settings)
        contents = {path.with_name(name): content for name, content in beside.items()} | {path: text.encode()}
    for each, content in contents.items():
        with whole_file(each) as part:
            part.write_bytes(content)
    return list(contents)


def _linear(colors: UInt8[ndarray, "vertices 3"]) -> UInt8[ndarray, "vertices 3"]:
    """Return sRGB codes as bytes of linear light, which glTF takes vertex colours for."""
    share = colors / 255.0
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.rint(255.0 * linear).astype(np.uint8)


def y_up(up: Float[ndarray, "3"]) -> Float[ndarray, "4 4"]:
    """Return the rotation that takes `up` to +y, and what a frame with z up calls x to x.

    >>> (y_up(np.array([0.0, 0.0, 1.0])) @ [1, 2, 3, 1]).tolist()
    [1.0, 3.0, -2.0, 1.0]
    """
    turned = np.eye(4)
    turned[:3, :3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) @ upright_rotation(torch.from_numpy(up)).numpy()
    return turned


def _as_gltf(up: Float[ndarray, "3"], metres: float, tree: dict[str, Any]) -> None:
    (root,) = tree["scenes"][tree["scene"]]["nodes"]
    placed = np.diag([metres, metres, metres, 1.0]) @ y_up(up)
    tree["nodes"][root]["matrix"] = placed.T.flatten().tolist()  # column by column
    _unlit(tree)


def _unlit(tree: dict[str, Any]) -> None:
    # The light is in the colours already: no viewer should add its own.
    tree["extensionsUsed"] = ["KHR_materials_unlit"]
    rough = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    tree.setdefault("materials", [{"pbrMetallicRoughness": rough}])[0]["extensions"] = {"KHR_materials_unlit": {}}
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0


def require_library(name: str, extra: str = "mesh") -> Any:
    """Return a module of an extra.

    Raises:
        InputError: it is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        package = name.partition(".")[0].replace("skimage", "scikit-image")
        raise InputError(
            f"Exporting {MADE_BY[extra]} needs {package}, which is not "
            f"installed or does not load here ({error}). Install it with: pip install 'nerf-lightning[{extra}]'"
        ) from error

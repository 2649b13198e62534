"""Mesh files: PLY, OBJ and GLB, with a colour and a normal for each vertex, by libraries that are an extra."""

from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from nerf_lightning.errors import InputError
from nerf_lightning.files.atomic import whole_file

MeshFormat = Literal["ply", "obj", "glb"]


def save_mesh(
    path: Path,
    vertices: Float[ndarray, "vertices 3"],
    faces: Int[ndarray, "faces 3"],
    normals: Float[ndarray, "vertices 3"],
    colors: UInt8[ndarray, "vertices 3"],
) -> None:
    """Write a mesh, whole or not at all; the ending says in which format."""
    trimesh = require_library("trimesh")
    form = path.suffix[1:]
    shown = _linear(colors) if form == "glb" else colors
    mesh = trimesh.Trimesh(vertices, faces, vertex_normals=normals, vertex_colors=shown, process=False)
    settings: dict[str, dict[str, Any]] = {
        "ply": {"vertex_normal": True},
        "obj": {"include_normals": True, "header": None},
        "glb": {"include_normals": True, "tree_postprocessor": _unlit},
    }
    content = mesh.export(file_type=form, **settings[form])
    with whole_file(path) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)


def _linear(colors: UInt8[ndarray, "vertices 3"]) -> UInt8[ndarray, "vertices 3"]:
    """Return sRGB codes as bytes of linear light, which glTF takes vertex colours for."""
    share = colors / 255.0
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.rint(255.0 * linear).astype(np.uint8)


def _unlit(tree: dict[str, Any]) -> None:
    # The light is in the colours already: no viewer should add its own.
    tree["extensionsUsed"] = ["KHR_materials_unlit"]
    rough = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    tree["materials"] = [{"pbrMetallicRoughness": rough, "extensions": {"KHR_materials_unlit": {}}}]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0


def require_library(name: str) -> Any:
    """Return a module of the extra `mesh`.

    Raises:
        InputError: it is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise InputError(
            f"Exporting a mesh needs {name.partition('.')[0].replace('skimage', 'scikit-image')}, which is not "
            f"installed or does not load here ({error}). Install it with: pip install 'nerf-lightning[mesh]'"
        ) from error

"""Charts: a mesh cut into pieces that lie flat in one square picture (xatlas), and which texel shows which place."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from nerf_lightning.errors import InputError
from nerf_lightning.export.mesh_files import require_library
from nerf_lightning.nerf.kernels.backends import twin, why_not

# Texels between charts, so that none shines into another where a viewer mixes neighbours.
PADDING = 4


@dataclass(frozen=True)
class Atlas:
    """A mesh whose vertices each have one place in a picture; where charts end, a vertex of the mesh has several."""

    source: Int[ndarray, "corners"]
    """Which vertex of the mesh each is."""
    faces: Int[ndarray, "faces 3"]
    uv: Float[ndarray, "corners 2"]
    """From 0 to 1: to the right and, as mesh files have it, up."""


@dataclass(frozen=True)
class Texels:
    """The texels of a picture that show something."""

    row: Int[ndarray, "texels"]
    column: Int[ndarray, "texels"]
    corners: Int[ndarray, "texels 3"]
    """The vertices of the mesh around each."""
    shares: Float[ndarray, "texels 3"]
    """And how near it is to each; they add up to 1."""


def make_atlas(vertices: Float[ndarray, "vertices 3"], faces: Int[ndarray, "faces 3"], size: int) -> Atlas:
    """Cut a mesh into charts and pack them into a picture of `size` texels a side."""
    xatlas = require_library("xatlas", "texture")
    atlas, packing = xatlas.Atlas(), xatlas.PackOptions()
    atlas.add_mesh(vertices.astype(np.float32), faces.astype(np.uint32))
    packing.resolution, packing.padding, packing.bilinear = size, PADDING, True
    atlas.generate(xatlas.ChartOptions(), packing)
    source, cut, uv = atlas[0]
    return Atlas(source.astype(np.int64), cut.astype(np.int64), uv)


def find_texels(atlas: Atlas, size: int) -> Texels:
    """Return the texels whose centres the charts cover."""
    kernels = twin("texels.cpu")
    if kernels is None:
        raise InputError(
            f"what.texture=true needs numba, which cannot be used here: {why_not('texels.cpu')}. Reinstall numba, or "
            "leave what.texture=true out for a colour per vertex."
        )
    down = np.stack([atlas.uv[:, 0], 1.0 - atlas.uv[:, 1]], axis=1) * size
    face, shares = kernels.covered_texels(down[atlas.faces], size)
    row, column = np.nonzero(face >= 0)
    corners = atlas.source[atlas.faces[face[row, column]]]
    return Texels(row, column, corners, shares[row, column])

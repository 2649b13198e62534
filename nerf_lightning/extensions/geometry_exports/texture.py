"""A texture for a mesh: flat charts in one square picture, and the color of each texel from the views."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.compute.machine import require_memory
from nerf_lightning.export.base import Report, require_kernels
from nerf_lightning.extensions.geometry_exports.mesh_files import require_library
from nerf_lightning.extensions.geometry_exports.surface import short_rays
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import for_terminal
from nerf_lightning.nerf.geometry.cameras import camera_coordinates, project
from nerf_lightning.nerf.geometry.subset import evenly_spaced_subset
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.tiles import tiles, weighted_renderings
from nerf_lightning.nerf.randomness import fold
from nerf_lightning.nerf.rendering.ray_statistics import transmittance_at
from nerf_lightning.nerf.types.rays import RayBundle
from nerf_lightning.nerf.types.scene import SceneRecord
from nerf_lightning.visualization.pictures import to_bytes

PADDING = 4  # Texels between charts, so that none bleeds into another when a viewer interpolates.
# Number of training views tested for visibility, and of those that contribute to a texel's color.
VIEWS, LOOKS = 100, 3
LEAST_COSINE = 0.1  # Views that see a surface at a smaller cosine are not used.
LEAST_SEEN = 1e-3  # A less visible texel gets the color of the nearest visible one.
LEAST_SIZE, LARGEST_SIZE = 16, 16_384
# Face, barycentric coordinates, color, and the nearest texel with a color: measured with charts that fill the picture.
BYTES_PER_TEXEL = 100
# Rays of texels begin this many times the reach before the surface, with this many samples: nearer, haze after a short
# training is painted too light; farther costs more without visible gain.
BEFORE, SAMPLES = 4.0, 20
CHUNK_TEXELS = 1 << 16  # Texels per chunk; progress is reported after each.


@dataclass(frozen=True)
class Atlas:
    """A mesh whose vertices each have one place in a picture; at chart borders, vertices of the mesh are duplicated."""

    source: Int[ndarray, "corners"]
    """The mesh's vertex that each one copies."""
    faces: Int[ndarray, "faces 3"]
    uv: Float[ndarray, "corners 2"]
    """From 0 to 1: to the right and, as in mesh files, up."""


@dataclass(frozen=True)
class Texels:
    """The texels of a picture that charts cover."""

    row: Int[ndarray, "texels"]
    column: Int[ndarray, "texels"]
    corners: Int[ndarray, "texels 3"]
    """The vertices of the mesh around each."""
    shares: Float[ndarray, "texels 3"]
    """Its barycentric coordinates; they add up to 1."""


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
    """Return the texels whose centers the charts cover."""
    cure = "Reinstall numba, or leave what.texture=true out for a color per vertex."
    texels = require_kernels(f"{__package__}.texels", "what.texture=true", cure)
    down = np.stack([atlas.uv[:, 0], 1.0 - atlas.uv[:, 1]], axis=1) * size
    face, shares = texels.covered_texels(down[atlas.faces], size)
    row, column = np.nonzero(face >= 0)
    corners = atlas.source[atlas.faces[face[row, column]]]
    return Texels(row, column, corners, shares[row, column])


def require_texture_room(size: int) -> None:
    """Refuse a texture that needs more memory than is available."""
    require_memory(
        f"what.texture_size={size} makes a picture of {size} x {size} texels",
        size,
        lambda side: BYTES_PER_TEXEL * side * side,
        lambda side: f"what.texture_size={side}",
    )


@dataclass
class TextureMaker:
    """Color the surface of a mesh from the training cameras that see it best.

    A full ray measures how well a camera sees a vertex; the color of a texel then takes only a short one, through the
    surface, as what is farther in front of it need not be evaluated again. Vertices and their unit outward normals are
    in the scene's frame; `reach` is the maximum distance of the mesh from the surface that the views see, in scene
    units.
    """

    model: Model
    record: SceneRecord
    points: Float[Tensor, "vertices 3"]
    normals: Float[Tensor, "vertices 3"]
    reach: float
    tile_points: int

    def __post_init__(self) -> None:
        self.views = evenly_spaced_subset(self.record.splits["train"], VIEWS)
        self.device = next(self.model.parameters()).device

    def __call__(self, texels: Texels, size: int, report: Report) -> UInt8[ndarray, "size size 3"]:
        """Return the picture; the nearest color continues between charts, so that no seam is visible."""
        scores = self.vertex_scores(report)
        colors = torch.zeros(len(texels.row), 3)
        seen = torch.zeros(len(texels.row), dtype=torch.bool)
        for part in tiles(len(texels.row), CHUNK_TEXELS):
            colors[part], seen[part] = self._colors(texels, part, scores)
            report("texels", part.stop / max(1, len(texels.row)))
        if not seen.any():
            raise InputError(
                f"No training view of {for_terminal(self.record.name)} sees the mesh, so there is nothing to make a "
                "texture from. Leave out what.texture=true, or train longer."
            )
        known = seen.numpy()
        picture, empty = np.zeros((size, size, 3), np.uint8), np.ones((size, size), bool)
        picture[texels.row[known], texels.column[known]] = to_bytes(colors[seen]).numpy()
        empty[texels.row[known], texels.column[known]] = False
        row, column = distance_transform_edt(empty, return_distances=False, return_indices=True)
        filled: UInt8[ndarray, "size size 3"] = picture[row, column]
        return filled

    def vertex_scores(self, report: Report) -> Float[Tensor, "vertices views"]:
        """Return how well each view sees each vertex: the squared cosine of the angle, times the light that arrives."""
        scores = torch.zeros(len(self.points), len(self.views))
        for number, view in enumerate(self.views):
            cosine = self._facing(view)
            asked = (cosine > LEAST_COSINE).nonzero()[:, 0]
            if len(asked):
                scores[asked, number] = cosine[asked].square() * self._arriving(self.points[asked], view)
            report("sight", (number + 1) / len(self.views))
        return scores

    def _facing(self, view: int) -> Float[Tensor, "vertices"]:
        """Return the cosine at which a view's camera sees each vertex; 0 if it is outside the picture."""
        cameras = self.record.cameras
        away = normalize(self.points - cameras.c2w[view, :, 3], dim=-1)
        ahead = (camera_coordinates(cameras, view, self.points)[:, 2] < 0) | (cameras.lens_model == "equirectangular")
        place = project(cameras, view, self.points)
        inside = (place >= 0).all(dim=-1) & (place[:, 0] < cameras.width[view]) & (place[:, 1] < cameras.height[view])
        return torch.where(ahead & inside, -(away * self.normals).sum(dim=-1), 0.0)

    def _colors(
        self, texels: Texels, part: slice, scores: Float[Tensor, "vertices views"]
    ) -> tuple[Float[Tensor, "part 3"], Bool[Tensor, "part"]]:
        corners, shares = torch.from_numpy(texels.corners[part]), torch.from_numpy(texels.shares[part])
        at = (shares[..., None] * self.points[corners]).sum(dim=1)
        # Interpolated between the vertices, so that views blend without an edge.
        score = sum(shares[:, corner, None] * scores[corners[:, corner]] for corner in range(3))
        best, which = torch.as_tensor(score).topk(min(LOOKS, len(self.views)), dim=1)
        light, weight = torch.zeros(len(at), 3), torch.zeros(len(at))
        eyes = self.record.cameras.c2w[torch.tensor(self.views), :, 3]
        for look in range(best.shape[1]):
            asked = (best[:, look] > 0).nonzero()[:, 0]
            share = best[asked, look]
            for some in tiles(len(asked), max(1, self.tile_points // SAMPLES)):
                here = asked[some]
                way = normalize(at[here] - eyes[which[here, look]], dim=-1)
                places, ways = at[here].to(self.device), way.to(self.device)
                seen = short_rays(self.model, places, ways, BEFORE * self.reach, self.reach, SAMPLES, closed=False)
                light[here] += share[some, None] * seen.foreground.cpu()
                weight[here] += share[some] * seen.opacity.cpu()
        return light / weight.clamp(min=torch.finfo(weight.dtype).tiny)[:, None], weight > LEAST_SEEN

    def _arriving(self, points: Float[Tensor, "points 3"], view: int) -> Float[Tensor, "points"]:
        """Return the share of the light from each place that reaches a view."""
        record = self.record
        way = points - record.cameras.c2w[view, :, 3]
        distance = way.norm(dim=-1)
        directions, origins = way / distance[:, None], record.cameras.c2w[view, :, 3].expand(points.shape)
        end = distance - self.reach
        near = torch.minimum(record.near[view], end).clamp(min=0.0)
        # Slightly beyond the place, since a ray of zero length would be sampled only at the surface.
        rays = RayBundle(origins, directions, near, distance + self.reach, directions).to(self.device)
        key, found = fold(0, "surface"), []
        for tile, levels in weighted_renderings(self.model, rays, record.background, key, self.tile_points):
            found.append(transmittance_at(levels[-1], tile, tile.far - 2.0 * self.reach).cpu())
        return torch.cat(found).float()

"""A texture for a mesh: each texel has the colour that the views which see it best have of it."""

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.compute.machine import require_memory
from nerf_lightning.errors import InputError
from nerf_lightning.escaping import for_terminal
from nerf_lightning.export.atlas import Texels
from nerf_lightning.export.density_grid import Report
from nerf_lightning.export.mesh_files import require_library
from nerf_lightning.export.surface import short_rays
from nerf_lightning.nerf.geometry.cameras import camera_coordinates, project
from nerf_lightning.nerf.geometry.subset import evenly_spaced_subset
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.tiles import tiles, weighted_renderings
from nerf_lightning.nerf.randomness import fold
from nerf_lightning.nerf.rendering.ray_statistics import transmittance_at
from nerf_lightning.nerf.types.rays import RayBundle
from nerf_lightning.nerf.types.scene import SceneRecord
from nerf_lightning.visualization.pictures import to_bytes

# Training views that are asked which places they see, and how many of them give a texel its colour.
VIEWS, LOOKS = 100, 3
# Views that see a surface less squarely (cosine) are not asked.
LEAST_COSINE = 0.1
# A texel of which less is seen has no colour of its own: that of the nearest one that has.
LEAST_SEEN = 1e-3
LEAST_SIZE, LARGEST_SIZE = 16, 16_384
# Which face and where on it, its colour, and the nearest that has one: measured, where charts fill the picture.
BYTES_PER_TEXEL = 100
# Rays of texels begin before the surface by so many times the reach, and have so many samples: nearer, what is hazy
# after a short training is painted too light; farther costs more and gains nothing that is seen.
BEFORE, SAMPLES = 4.0, 20
# Texels that are looked at together; a report follows each lot.
TOGETHER = 1 << 16


def require_texture_room(size: int) -> None:
    """Refuse a texture that takes more memory than can be had.

    Raises:
        InputError: with the size that would fit.
    """
    require_memory(
        f"what.texture_size={size} makes a picture of {size} x {size} texels",
        size,
        lambda side: BYTES_PER_TEXEL * side * side,
        lambda side: f"what.texture_size={side}",
    )


class TextureMaker:
    """Look at the places of a mesh from the training cameras that see them best.

    How well a camera sees a vertex is told by a whole ray; the colour of a texel then by a short one, through the
    surface: what lies farther before it need not be asked about again.

    Args:
        model: in evaluation mode.
        record: of the scene.
        points: the mesh's vertices, scene frame.
        normals: unit, outward.
        reach: how far the mesh may be from the surface that the views see, scene units.
        tile_points: most points that go through the field at once.
    """

    def __init__(
        self,
        model: Model,
        record: SceneRecord,
        points: Float[Tensor, "vertices 3"],
        normals: Float[Tensor, "vertices 3"],
        reach: float,
        tile_points: int,
    ):
        self.model, self.record, self.tile_points = model, record, tile_points
        self.points, self.normals, self.reach = points, normals, reach
        self.views, self.device = evenly_spaced_subset(record.splits["train"], VIEWS), next(model.parameters()).device

    def __call__(self, texels: Texels, size: int, report: Report) -> UInt8[ndarray, "size size 3"]:
        """Return the picture; between charts the nearest colour goes on, so that no seam shows.

        Raises:
            InputError: no training view sees any of it.
        """
        scores = self.vertex_scores(report)
        colors = torch.zeros(len(texels.row), 3)
        seen = torch.zeros(len(texels.row), dtype=torch.bool)
        for part in tiles(len(texels.row), TOGETHER):
            colors[part], seen[part] = self._colors(texels, part, scores)
            report("texels", part.stop / max(1, len(texels.row)))
        if not seen.any():
            raise InputError(
                f"No training view of {for_terminal(self.record.name)} sees the mesh, so that there is nothing to make "
                "a texture of. Leave what.texture=true out, or train longer."
            )
        known = seen.numpy()
        picture, empty = np.zeros((size, size, 3), np.uint8), np.ones((size, size), bool)
        picture[texels.row[known], texels.column[known]] = to_bytes(colors[seen]).numpy()
        empty[texels.row[known], texels.column[known]] = False
        morphology = require_library("scipy.ndimage")
        row, column = morphology.distance_transform_edt(empty, return_distances=False, return_indices=True)
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
        """Return the cosine at which a view's camera sees each vertex; 0 where it does not stand in the picture."""
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
        # Mixed between the vertices, so that one view takes over from another without an edge.
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

    def _arriving(self, at: Float[Tensor, "points 3"], view: int) -> Float[Tensor, "points"]:
        """Return the share of the light that comes from each place to a view."""
        record = self.record
        way = at - record.cameras.c2w[view, :, 3]
        distance = way.norm(dim=-1)
        directions, origins = way / distance[:, None], record.cameras.c2w[view, :, 3].expand(at.shape)
        end = distance - self.reach
        near = torch.minimum(record.near[view], end).clamp(min=0.0)
        # A little beyond the place, since a ray that ends at once would be sampled at the surface alone.
        rays = RayBundle(origins, directions, near, distance + self.reach, directions).to(self.device)
        found = []
        for tile, levels in weighted_renderings(
            self.model, rays, record.background, fold(0, "surface"), self.tile_points
        ):
            found.append(transmittance_at(levels[-1], tile, tile.far - 2.0 * self.reach).cpu())
        return torch.cat(found).float()

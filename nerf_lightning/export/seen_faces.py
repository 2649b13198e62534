"""The faces of a mesh that a photograph shows: behind them a field may hold anything."""

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from nerf_lightning.checkpoints import SceneRecord
from nerf_lightning.errors import InputError
from nerf_lightning.export.lattice import Report
from nerf_lightning.export.seen_views import at_most, num_agreeing, see
from nerf_lightning.geometry.spread import spread
from nerf_lightning.models.levels import RadianceModel

# Training views that are rendered, and their longer side in pixels.
VIEWS, LONGEST = 60, 400
# A vertex is seen where a view's depth is its distance, up to this share of it.
TOLERANCE = 0.015
# Pixels that stop less light see no surface.
OPAQUE = 0.5
# The rim of what is seen grows by so many rings of faces, so that grazed and thin places get no holes.
RINGS = 2


def seen_faces(
    model: RadianceModel,
    record: SceneRecord,
    vertices: Float[ndarray, "vertices 3"],
    faces: Int[ndarray, "faces 3"],
    tile_points: int,
    report: Report,
    stage: str = "views",
) -> Int[ndarray, "seen 3"]:
    """Return the faces that a training view sees, or whose neighbours it does.

    Raises:
        InputError: there are none.
    """
    cameras, views = at_most(record.cameras, LONGEST), spread(record.splits["train"], VIEWS)
    points = torch.from_numpy(vertices).float()
    seen = torch.zeros(len(points), dtype=torch.bool)
    for number, view in enumerate(views):
        picture = see(model, record, cameras, view, tile_points)
        depth = torch.where(picture.opacity > OPAQUE, picture.depth, torch.inf)
        seen |= num_agreeing(points, cameras, {view: depth}, [view], TOLERANCE) > 0
        report(stage, (number + 1) / len(views))
    known = seen.numpy()
    kept = known[faces].any(axis=1)
    for _ in range(RINGS):
        known[faces[kept]] = True
        kept = known[faces].any(axis=1)
    if not kept.any():
        raise InputError(
            "No training view sees any part of the mesh as its surface: what.threshold is far from the density that "
            "the views end in. Give another, or what.threshold=null, or what.seen_only=false."
        )
    return np.ascontiguousarray(faces[kept])

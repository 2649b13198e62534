"""Pixels of known distance, from the sparse points of structure from motion or from a depth sensor."""

import logging
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from nerf_lightning.data.captures.capture import Capture
from nerf_lightning.data.pixels.picture_files import read_depth
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.geometry.cameras import rays_through_pixels, seen_at
from nerf_lightning.nerf.types.rays import KnownDepths, PixelIndex
from nerf_lightning.nerf.types.scene import Cameras
from nerf_lightning.nerf.types.tensor_struct import concatenate

CERTAIN = 0.03
"""Relative error at which a distance counts half."""
LEAST_ERROR, UNKNOWN_ERROR = 0.3, 1.0
"""Reprojection error in pixels: the minimum, and the default if none is given."""
LEAST_CERTAINTY = 0.05
OF_A_SENSOR = 0.9
"""Certainty of a measured distance: sensors err by a hundredth."""
MOST_OF_A_MAP = 4096
"""Maximum number of pixels used of a depth map, evenly spread."""
LEVELS = 1000
"""Number of a sensor's levels, which are millimeters, in a unit of the capture."""
STRETCH = 0.02
"""Tolerance of a depth map's aspect ratio against the photograph's: beyond, it belongs to another picture."""

log = logging.getLogger(__name__)


def known_depths(capture: Capture, cameras: Cameras) -> KnownDepths | None:
    """Return all known distances of a capture, in its own units; None if there are none.

    Args:
        capture: with tracks, or depth maps, or neither.
        cameras: of its views, in its own frame, at the size of the pixels.
    """
    found = []
    if len(capture.tracks):
        found.append(depths_of_points(capture.points, capture.point_errors, capture.tracks, cameras))
    if any(view.depth is not None for view in capture.views):
        maps = [(view.depth, view.depth_unit) for view in capture.views]
        found.append(depths_of_maps(maps, capture.depth_unit, cameras))
    every = concatenate(found) if found else None
    return every if every is not None and len(every) else None


def depths_of_maps(maps: Sequence[tuple[Path | None, float | None]], level: float, cameras: Cameras) -> KnownDepths:
    """Return distances measured by depth sensors; unusable maps are left out and logged.

    Args:
        maps: one per view, of any size with the photograph's aspect ratio (None: no map), and its unit's length in the
            units of the cameras; None: `level`, or 1000 of them if it contains lengths.
        level: the length of a sensor's level, in the units of the cameras.
        cameras: at the size of the pixels.
    """
    found, odd = [KnownDepths(PixelIndex(*(torch.zeros(0, dtype=torch.int64),) * 3), *(torch.zeros(0),) * 2)], []
    zeros, turned = torch.zeros(len(maps)), replace(cameras, c2w=cameras.c2w.float())
    for view, (path, unit) in enumerate(maps):
        if path is None:
            continue
        try:
            stored, counts_levels = read_depth(path)
            depth = torch.from_numpy(stored)
        except InputError as error:
            odd.append(str(error).split(". ")[0])
            continue
        (rows, columns), width, height = depth.shape, int(cameras.width[view]), int(cameras.height[view])
        if abs(columns * height / (rows * width) - 1.0) > STRETCH:
            odd.append(f"{path.name} has another shape than its photograph")
            continue
        step = max(1, math.ceil(math.sqrt(rows * columns / MOST_OF_A_MAP)))
        y, x = (depth > 0)[::step, ::step].nonzero().mul(step).unbind(dim=1)
        column, row = ((at + 0.5) * size / of for at, size, of in ((x, width, columns), (y, height, rows)))
        pixels = PixelIndex(torch.full_like(x, view), column.long(), row.long())
        directions = rays_through_pixels(turned, pixels, zeros, zeros).directions
        ahead = -(directions @ cameras.c2w[view, :, 2].to(directions)).clamp(max=-1e-3)
        unit = unit or (level if counts_levels else LEVELS * level)
        distance = (unit * depth[y, x].double() / ahead).float()
        sound = distance.isfinite() & (distance > 0)
        found.append(KnownDepths(pixels[sound], distance[sound], torch.full_like(distance[sound], OF_A_SENSOR)))
    if odd:
        log.warning("%d depth maps are left out: %s", len(odd), listed(odd, 3))
    return concatenate(found)


def depths_of_points(
    points: Float[Tensor, "points 3"],
    errors: Float[Tensor, "points"],
    tracks: Int[Tensor, "seen 2"],
    cameras: Cameras,
) -> KnownDepths:
    """Return the distances of sparse points from the cameras that saw them, in the units of the cameras.

    A distance's uncertainty follows from the point's reprojection error: relative to the distance, it is the error's
    angle over that between the rays that meet in the point. Distances that are too uncertain are left out, as are
    points behind a camera or outside its picture.

    Args:
        points: in the cameras' frame.
        errors: mean reprojection error of each point in pixels.
        tracks: which point was seen in which view.
        cameras: at the size of the pixels.
    """
    found = []
    point, view = tracks.unbind(dim=1)
    toward = cameras.c2w[view, :, 3] - points[point]
    distance = toward.norm(dim=-1)
    angle = spread(functional.normalize(toward, dim=-1), point, len(points))[point]
    pixel = 1.0 / cameras.focal.double().mean(dim=-1)[view]
    errors = torch.where(errors >= 0.0, errors, UNKNOWN_ERROR).clamp(min=LEAST_ERROR)
    relative = errors[point] * pixel / angle.clamp(min=1e-9)
    certainty = 1.0 / (1.0 + (relative / CERTAIN).square())
    seen_by, count = view.sort(stable=True).values.unique_consecutive(return_counts=True)
    for number, rows in zip(seen_by.tolist(), view.argsort(stable=True).split(count.tolist()), strict=True):
        own = rows[certainty[rows] >= LEAST_CERTAINTY]
        inside, x, y = seen_at(cameras, number, points[point[own]])
        kept = own[inside]
        pixels = PixelIndex(torch.full_like(kept, number), x[inside], y[inside])
        found.append(KnownDepths(pixels, distance[kept].float(), certainty[kept].float()))
    return concatenate(found)


def spread(directions: Float[Tensor, "seen 3"], point: Int[Tensor, "seen"], num_points: int) -> Float[Tensor, "points"]:
    """Return about the largest angle (radians) between any two directions of each point: twice that from their mean."""
    mean = torch.zeros(num_points, 3, dtype=directions.dtype).index_add_(0, point, directions)
    mean = functional.normalize(mean, dim=-1)
    angle = 2.0 * ((directions - mean[point]).norm(dim=-1) / 2.0).clamp(max=1.0).asin()
    return 2.0 * torch.zeros(num_points, dtype=directions.dtype).scatter_reduce_(0, point, angle, "amax")

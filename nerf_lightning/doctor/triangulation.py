"""Distances for captures without any: triangulate matches of photographs with the given cameras.

Without them, few photographs do not determine where things are: with 14 photographs of a cup, 600 steps reach 16 dB,
and 25 dB with them (docs/measurements.md). Held-out photographs are not used.

Which runs take them: `takes_distances` in `config/auto_settings.py`.
"""

import logging
from dataclasses import replace

import torch

from nerf_lightning.compute import ranks
from nerf_lightning.compute.machine import torch_threads
from nerf_lightning.data.captures.known_depths import depths_of_points
from nerf_lightning.data.pixels.store import in_threads
from nerf_lightning.doctor.epipolar import agreeing, line_distances, places
from nerf_lightning.doctor.examine import NOTICEABLE
from nerf_lightning.doctor.features import Corners, find_corners, shrunk_cameras, small_picture
from nerf_lightning.doctor.matches import matched_pairs, nearest_views
from nerf_lightning.nerf.geometry.subset import evenly_spaced_subset
from nerf_lightning.nerf.types.rays import KnownDepths
from nerf_lightning.nerf.types.scene import Scene

LONGER_SIDE, MOST_CORNERS = 576, 2000  # Twice as fine as for checks: distances are as accurate as corners.
PARTNERS = 6  # Number of views that each is matched with,
MOST_VIEWS = 200  # evenly spread if there are more.
LEAST_ERROR = 0.7  # Pixels of the shrunk pictures: no corner is found more accurately.
LEAST_AGREEING = 0.15  # Share of the matches that agree with the cameras: 0.29 to 0.71; if wrong, at most 0.04.
FEWEST = 10  # Distances per view.

log = logging.getLogger(__name__)


def with_distances(scene: Scene) -> Scene:
    """Return the scene with distances from its training views, if it has none and they yield enough."""
    if scene.depths is not None or scene.capture_of is not None:
        return scene
    with torch_threads(1):  # Pictures are spread over our own threads.
        found = ranks.from_first(lambda: triangulated(scene))
    return scene if found is None else replace(scene, depths=replace(found, from_pictures=True))


def triangulated(scene: Scene) -> KnownDepths | None:
    """Return the distances of corners that two training views show and their cameras explain; None if there are few."""
    views = evenly_spaced_subset(scene.splits["train"], MOST_VIEWS)
    cameras, shown = shrunk_cameras(scene.cameras, LONGER_SIDE), len(views) > NOTICEABLE

    def corners_of(number: int) -> Corners:
        size = int(cameras.width[views[number]]), int(cameras.height[views[number]])
        return find_corners(small_picture(scene.pixels, views[number], *size), MOST_CORNERS)

    corners = dict(zip(views, in_threads(corners_of, len(views), "Finding corners", shown), strict=True))
    numbers = torch.tensor(views)
    near = nearest_views(scene.cameras.c2w, numbers, numbers, PARTNERS)
    pairs = {(min(a, b), max(a, b)) for a, others in zip(views, near.tolist(), strict=True) for b in others}
    matches = matched_pairs(cameras, corners, sorted(pairs), shown)
    agrees = agreeing(matches, scene.cameras.c2w)
    matches, count = matches.where(agrees), int(agrees.sum())
    if count <= LEAST_AGREEING * len(agrees):
        return None
    larger = (scene.cameras.focal / cameras.focal).mean(dim=-1).double()[matches.view[:, 0]]
    errors = larger * line_distances(matches, scene.cameras.c2w).amax(dim=-1).clamp(min=LEAST_ERROR)
    tracks = torch.stack([torch.arange(count).repeat(2), matches.view.T.flatten()], dim=1)
    exact = replace(scene.cameras, c2w=scene.cameras.c2w.double())
    found = depths_of_points(places(matches, scene.cameras.c2w).double(), errors, tracks, exact)
    if len(found) < FEWEST * len(views):
        return None
    log.info("distances: %s pixels, triangulated from matches between photographs", f"{len(found):,}")
    return found

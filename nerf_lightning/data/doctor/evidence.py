"""Gather what the checks look at: each photograph is opened once."""

import torch

from nerf_lightning.data.doctor.check import Evidence
from nerf_lightning.data.doctor.epipolar import agreeing
from nerf_lightning.data.doctor.features import Corners, find_corners, shrunk_cameras, small_picture
from nerf_lightning.data.doctor.looks import look_at_view, stacked
from nerf_lightning.data.doctor.matches import find_matches
from nerf_lightning.data.pixel_store import in_threads
from nerf_lightning.types.scene import Scene

# More views than these are thinned out evenly to be compared with each other; that costs the square.
MOST_COMPARED = 160
NOTICEABLE = 30


def gather(scene: Scene) -> Evidence:
    """Return what the checks need to know of a scene; takes seconds."""
    total = len(scene.view_names)
    compared = {total * number // min(total, MOST_COMPARED) for number in range(min(total, MOST_COMPARED))}
    cameras = shrunk_cameras(scene.cameras)
    corners: dict[int, Corners] = {}

    def look(view: int) -> tuple[torch.Tensor, ...]:
        picture = small_picture(scene.pixels, view, int(cameras.width[view]), int(cameras.height[view]))
        if view in compared:
            corners[view] = find_corners(picture)
        return look_at_view(scene.pixels, view, picture)

    rows = in_threads(look, total, "Looking at photographs", shown=total > NOTICEABLE)
    matches = find_matches(cameras, corners, shown=total > NOTICEABLE)
    return Evidence(scene, stacked(rows), matches, agreeing(matches, scene.cameras.c2w))

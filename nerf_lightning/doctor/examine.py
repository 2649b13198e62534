"""Analyze a capture, and judge it by all checks. A new check is a function, listed in CHECKS of its file."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from nerf_lightning.compute.machine import torch_threads
from nerf_lightning.data.pixels.store import in_threads
from nerf_lightning.doctor import cameras, extent, image_quality, poses
from nerf_lightning.doctor.check import Analysis, Check, CheckFn
from nerf_lightning.doctor.epipolar import agreeing
from nerf_lightning.doctor.features import Corners, Looks, find_corners, look_at_view, shrunk_cameras, small_picture
from nerf_lightning.doctor.matches import likely_pairs, matched_pairs
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.types.scene import Scene

CHECKS: dict[str, CheckFn] = {
    **cameras.CHECKS,
    **poses.CHECKS,
    **extent.CHECKS,
    **cameras.OF_VIEWS,
    **image_quality.CHECKS,
}


FIRST_ADVICE = ("coverage", "photographs without pose", "number of views", "overlap")
"""Checks whose cures are worth most: nothing compensates for missing photographs."""


def examine(scene: Scene) -> tuple[Analysis, list[Check]]:
    """Return the analysis, and the outcome of every check; takes seconds."""
    if scene.capture_of is not None:
        raise InputError(
            f"{scene.name} joins {len(scene.captures)} captures, and the doctor examines one at a time: give "
            "scene=auto scene.root=DIR; or doctor=off to train all the same."
        )
    # Pictures are distributed over our own threads; torch's would only get in their way.
    with torch_threads(1):
        analysis = analyze(scene)
        return analysis, [replace(check(analysis), name=name) for name, check in CHECKS.items()]


def advice(checks: Sequence[Check]) -> str | None:
    """Return the one cure that would improve a result most; None if nothing was found."""
    doubtful = {check.name: check.cure for check in checks if check.verdict in ("look", "wrong") and check.cure}
    return next((doubtful[name] for name in [*FIRST_ADVICE, *doubtful] if name in doubtful), None)


# If there are more views, an even subset is compared with each other; the cost is quadratic.
MOST_COMPARED = 160
NOTICEABLE = 30


def analyze(scene: Scene) -> Analysis:
    """Return what the checks need to know about a scene; takes seconds."""
    total = len(scene.view_names)
    compared = {total * number // min(total, MOST_COMPARED) for number in range(min(total, MOST_COMPARED))}
    cameras = shrunk_cameras(scene.cameras)
    corners: dict[int, Corners] = {}

    def row_of(view: int) -> tuple[torch.Tensor, ...]:
        picture = small_picture(scene.pixels, view, int(cameras.width[view]), int(cameras.height[view]))
        if view in compared:
            corners[view] = find_corners(picture)
        return look_at_view(scene.pixels, view, picture)

    rows = in_threads(row_of, total, "Looking at photographs", visible=total > NOTICEABLE)
    matches = matched_pairs(cameras, corners, likely_pairs(corners), visible=total > NOTICEABLE)
    looks = Looks(*(torch.stack(column) for column in zip(*rows, strict=True)))
    return Analysis(scene, looks, matches, agreeing(matches, scene.cameras.c2w), corners)

"""Any camera path as keyframes, for a player that supports no other kind, and for the user to edit by hand."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.cameras import focal_from_fov
from nerf_lightning.nerf.geometry.world_frame import directions_to_user, points_to_user
from nerf_lightning.video.paths.base import CameraPath, PathFrame
from nerf_lightning.video.paths.keyframe_path import KeyframeCurve, KeyframePath
from nerf_lightning.video.paths.keyframes import Keyframe, Point

MOST = 24
"""Number of keyframes for a path that has none of its own: for a circle, their curve is one to within 1e-4."""
NEAREST_TARGET = 0.1  # Minimum distance of what a camera looks at, as a share of the scene's radius.
CLOSED = 1.5  # A path is closed if its last camera is this near its first one, in steps of its first frame.


def as_keyframes(path: CameraPath, around: PathFrame) -> list[Keyframe]:
    """Return complete keyframes whose curve follows a path; none for a single camera."""
    if isinstance(path, KeyframePath):
        return _of_file(path, around) if path.times or path.seconds else []
    cameras = path.cameras(around)
    count = len(cameras.c2w)
    chosen = torch.linspace(0, count - 1, min(MOST, count)).round().long()
    times = chosen.double() / path.fps
    if _closes(cameras.c2w):
        chosen, times = torch.cat([chosen, chosen[:1]]), torch.cat([times, times.new_tensor([count / path.fps])])
    focal = cameras.focal[chosen, 0] * around.width / cameras.width[chosen]
    return _keyframes(cameras.c2w[chosen].double(), focal, times, [None] * len(chosen), around)


def _of_file(path: KeyframePath, around: PathFrame) -> list[Keyframe]:
    """Return the path's own keyframes."""
    curve = KeyframeCurve(path.keyframes, around, path.times, path.closed)
    times = curve.knots if path.times else curve.knots * path.seconds
    focal = curve.focal(curve.knots)
    if path.fov is not None:
        focal = torch.full_like(focal, focal_from_fov(around.width, math.radians(path.fov)))
    targets = [each.look_at for each in path.keyframes]
    given = [*targets, *targets[: len(times) - len(targets)]]  # a closed curve passes the first one twice
    return _keyframes(curve.poses(curve.knots), focal, times, given, around)


def _closes(c2w: Float[Tensor, "frames 3 4"]) -> bool:
    if len(c2w) < 3:
        return False
    apart = (c2w - c2w.roll(1, dims=0)).flatten(1).norm(dim=1)
    return bool(0 < apart[0] < CLOSED * apart[1])


def _keyframes(
    c2w: Float[Tensor, "keys 3 4"],
    focal: Float[Tensor, "keys"],
    times: Float[Tensor, "keys"],
    targets: Sequence[Point | None],
    around: PathFrame,
) -> list[Keyframe]:
    if len(c2w) < 2:
        return []
    to_user, eyes = around.to_user.double(), c2w[:, :, 3]
    away = ((eyes - around.center.double()) * c2w[:, :, 2]).sum(dim=1).clamp(min=NEAREST_TARGET * around.radius)
    ahead = points_to_user(eyes - away[:, None] * c2w[:, :, 2], to_user)
    eyes, ups = points_to_user(eyes, to_user), directions_to_user(c2w[:, :, 1], to_user)
    fovs = torch.rad2deg(2 * torch.atan(0.5 * around.width / focal.double()))
    rows = zip(eyes.tolist(), targets, ahead.tolist(), ups.tolist(), fovs.tolist(), times.tolist(), strict=True)
    return [
        Keyframe(tuple(eye), look_at=target or tuple(far), up=tuple(up), fov=fov, time=time)
        for eye, target, far, up, fov, time in rows
    ]

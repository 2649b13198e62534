"""A working frame for a capture: which way is up, where the middle is, how large a unit is; and where cameras look."""

from dataclasses import replace

import torch
from jaxtyping import Float, Float64
from torch import Tensor
from torch.nn import functional

from nerf_lightning.nerf.matmul_precision import disable_autocast
from nerf_lightning.nerf.types.scene import Cameras, Scene, SceneRecord

FORWARD_FACING = 0.82
"""Cosine of the widest angle between a camera and the mean direction of forward-facing cameras (about 35 degrees)."""

# An axis is clear if its eigenvalue is smaller than the next by this much, as a share of the cameras.
CLEAR = 0.05

LEAST_UNIT, LARGEST_UNIT = 1e-12, 1e12
"""Limits of a scene unit in the user's units: from atoms to planets."""


@disable_autocast
def focus_point(c2w: Float[Tensor, "views 3 4"]) -> Float[Tensor, "3"]:
    """Return the point that is nearest to all optical axes, by least squares.

    sum (I - d d^T) x = sum (I - d d^T) o. Where the axes are almost parallel, the cameras' mean is a weak fallback.

    >>> eyes = torch.tensor([[4.0, 0, 1], [0.0, 4, 1]])
    >>> from nerf_lightning.nerf.geometry.poses import look_at
    >>> focus_point(look_at(eyes, torch.tensor([[0.0, 0, 1]] * 2), torch.tensor([0.0, 0, 1]))).round(decimals=3)
    tensor([0., 0., 1.])
    """
    origins, along = c2w[:, :, 3], c2w[:, :, 2]
    across = torch.eye(3).to(c2w) - along[:, :, None] * along[:, None, :]
    weak = 1e-6 * torch.eye(3).to(c2w)
    target = (across @ origins[..., None])[..., 0].mean(dim=0) + weak @ origins.mean(dim=0)
    return torch.linalg.solve(across.mean(dim=0) + weak, target)


@disable_autocast
def middle_of_cameras(cameras: Cameras) -> Float[Tensor, "3"]:
    """Return the middle that the cameras are around: where their axes meet, or where the cameras are.

    Panoramas look everywhere, and their axes mean nothing: they are in the middle of what they show.
    """
    if cameras.lens_model == "equirectangular":
        return cameras.c2w[:, :, 3].mean(dim=0)
    return focus_point(cameras.c2w)


@disable_autocast
def least_agreement(c2w: Float[Tensor, "views 3 4"]) -> float:
    """Return the cosine between the cameras' mean direction and the direction farthest from it.

    >>> least_agreement(torch.eye(4)[:3].repeat(2, 1, 1))
    1.0
    """
    back = c2w[:, :, 2]
    return float((back @ functional.normalize(back.mean(dim=0), dim=0)).min())


@disable_autocast
def up_direction(c2w: Float[Tensor, "views 3 4"]) -> Float[Tensor, "3"]:
    """Return the unit vector that points up in the world, judged by how the photographer held the camera.

    Photographs are level: their rows are horizontal, so up is perpendicular to all right axes; for photographs on their
    side, to all up axes. The clearer of the two counts. If neither is clear, since all cameras look the same way, it is
    the mean of their up axes.
    """
    right, up, back = c2w[:, :, :3].unbind(dim=-1)
    mean_up = functional.normalize(up.mean(dim=0), dim=0)
    best, axis = CLEAR, None
    for rows in (right, up):
        values, vectors = torch.linalg.eigh(rows.mT @ rows / len(rows))
        clear = float(values[1] - values[0])
        if clear > best and float(values[0]) < 0.5 * float(values[1]):
            best, axis, upright = clear, vectors[:, 0], rows is right
    if axis is None:
        return mean_up
    # Photographs on their side do not show which end is up: people look down on things.
    sign = (axis @ mean_up) if upright else (axis @ back.mean(dim=0))
    return axis if sign >= 0 else -axis


@disable_autocast
def upright_rotation(up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Return the smallest rotation that maps `up` (unit) to +z.

    >>> (upright_rotation(torch.tensor([0.0, 1, 0])) @ torch.tensor([0.0, 1, 0])).tolist()
    [0.0, 0.0, 1.0]
    """
    z = torch.tensor([0.0, 0.0, 1.0]).to(up)
    cross, cosine = torch.linalg.cross(up, z), float(up @ z)
    if cosine < -1.0 + 1e-9:
        return torch.diag(torch.tensor([1.0, -1.0, -1.0]).to(up))
    skew = torch.zeros(3, 3).to(up)
    skew[0, 1], skew[0, 2], skew[1, 2] = -cross[2], cross[1], -cross[0]
    skew = skew - skew.mT
    return torch.eye(3).to(up) + skew + skew @ skew / (1.0 + cosine)


@disable_autocast
def y_up(up: Float[Tensor, "3"]) -> Float[Tensor, "4 4"]:
    """Return the rotation that maps `up` (unit) to +y, as in glTF, and the x axis of a z-up frame to x.

    >>> (y_up(torch.tensor([0.0, 0.0, 1.0])) @ torch.tensor([1.0, 2.0, 3.0, 1.0])).tolist()
    [1.0, 3.0, -2.0, 1.0]
    """
    turned = torch.eye(4).to(up)
    turned[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]).to(up) @ upright_rotation(up)
    return turned


def gaps_around(azimuth: Float[Tensor, "views"]) -> tuple[Float[Tensor, "views"], Float[Tensor, "views"]]:
    """Return sorted azimuths in degrees, and the gap from each to the next (from the last one to the first).

    >>> [part.tolist() for part in gaps_around(torch.tensor([90.0, 0.0, -120.0]))]
    [[-120.0, 0.0, 90.0], [120.0, 90.0, 150.0]]
    """
    around = azimuth.sort().values
    return around, torch.cat([around[1:], around[:1] + 360]) - around


def average_pose(c2w: Float[Tensor, "views 3 4"]) -> Float[Tensor, "3 4"]:
    """Return the average pose of cameras that look the same way, as in LLFF."""
    back = functional.normalize(c2w[:, :, 2].sum(dim=0), dim=0)
    right = functional.normalize(torch.linalg.cross(c2w[:, :, 1].sum(dim=0), back), dim=0)
    return torch.stack([right, torch.linalg.cross(back, right), back, c2w[:, :, 3].mean(dim=0)], dim=-1)


def similarity(rotation: Float[Tensor, "3 3"], center: Float[Tensor, "3"], unit: float) -> Float64[Tensor, "4 4"]:
    """Return `to_user`, in float64: x_user = unit * rotation x + center.

    Args:
        rotation: the working frame's axes, as columns in the user's frame.
        center: the working frame's origin in the user's frame.
        unit: how many of the user's units make one of the scene's.
    """
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3], matrix[:3, 3] = unit * rotation.double(), center
    return matrix


@disable_autocast
def poses_from_user(c2w: Float[Tensor, "views 3 4"], to_user: Float[Tensor, "4 4"]) -> Float[Tensor, "views 3 4"]:
    """Return poses in the working frame, given in the user's frame."""
    centers = points_from_user(c2w[:, :, 3], to_user)
    rotation = to_user[:3, :3] / unit_of(to_user)
    return torch.cat([rotation.mT @ c2w[:, :, :3], centers[:, :, None]], dim=-1)


@disable_autocast
def points_from_user(points: Float[Tensor, "points 3"], to_user: Float[Tensor, "4 4"]) -> Float[Tensor, "points 3"]:
    """Return points in the working frame, given in the user's frame."""
    rotation = to_user[:3, :3] / unit_of(to_user)
    return (points - to_user[:3, 3]) @ rotation / unit_of(to_user)


@disable_autocast
def points_to_user(points: Float[Tensor, "*points 3"], to_user: Float[Tensor, "4 4"]) -> Float[Tensor, "*points 3"]:
    """Return points in the user's frame, given in the working frame."""
    return points @ to_user[:3, :3].mT + to_user[:3, 3]


@disable_autocast
def directions_to_user(
    directions: Float[Tensor, "*points 3"], to_user: Float[Tensor, "4 4"]
) -> Float[Tensor, "*points 3"]:
    """Return directions in the user's frame, given in the working frame, of the same length."""
    return directions @ to_user[:3, :3].mT / unit_of(to_user)


def unit_of(to_user: Float[Tensor, "4 4"]) -> float:
    """Return how many of the user's units make one of the scene's."""
    return float(torch.linalg.det(to_user[:3, :3]).abs()) ** (1 / 3)


def told_length(record: SceneRecord) -> tuple[float, str]:
    """Return the factor from lengths in the scene's frame to those shown to the user, and their unit.

    Meters if the length of the capture's unit is known; else the capture's own units.
    """
    unit = unit_of(record.to_user.double())
    if record.metres_per_unit is None:
        return unit, "the capture's units"
    return unit * record.metres_per_unit, "meters"


def middle_of(scene: SceneRecord) -> Float[Tensor, "3"]:
    """Return the middle that the views are around: that of the box, or where the cameras' axes meet."""
    if scene.space == "bounded":
        return scene.aabb.mean(dim=0)
    if scene.space == "ndc" and isinstance(scene, Scene) and len(scene.points):
        return scene.points.median(dim=0).values
    if scene.space == "ndc":
        return torch.tensor([0.0, 0.0, -2.0])
    return middle_of_cameras(replace(scene.cameras, c2w=scene.cameras.c2w.double())).float()


def directions_seen(scene: SceneRecord) -> tuple[Float[Tensor, "views"], Float[Tensor, "views"]]:
    """Return azimuth (from x toward y) and elevation in degrees of each camera, as seen from the middle."""
    x, y, z = (scene.cameras.c2w[:, :, 3] - middle_of(scene)).unbind(dim=-1)
    return torch.atan2(y, x).rad2deg(), torch.atan2(z, (x.square() + y.square()).sqrt()).rad2deg()


def central_view(scene: SceneRecord) -> int:
    """Return the training view whose camera is nearest to the training cameras' mean, in place and direction.

    Without training views, it is one of all views.

    Pages start there: the model knows most about what is there, and it is oriented like most photographs.
    """
    train = list(scene.splits.get("train", ())) or list(range(len(scene.cameras.c2w)))
    c2w = scene.cameras.c2w[train]
    spread = c2w[:, :, 3].std(dim=0, correction=0).norm().clamp(min=1e-6)
    apart = c2w - c2w.mean(dim=0)
    apart[:, :, 3] /= spread
    return train[int(apart.flatten(1).norm(dim=1).argmin())]

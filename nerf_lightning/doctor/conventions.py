"""Other conventions that a capture's poses or photographs may follow."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.doctor.matches import Matches
from nerf_lightning.nerf.geometry.poses import quaternion_from_rotation, rotation_from_quaternion
from nerf_lightning.nerf.types.scene import Cameras, Scene

FLIP_YZ = (1.0, -1.0, -1.0)
SHIFT = "Shift the list of photographs by one relative to the poses; a picture may be missing at one end."


@dataclass(frozen=True)
class Reading:
    """Another way to read a capture."""

    says: str
    """How the capture looks; completes "the poses look ..."."""
    cure: str
    change: Callable[[Scene, Matches], tuple[Float[Tensor, "views 3 4"], Matches]]


def inverted(c2w: Float[Tensor, "views 3 4"]) -> Float[Tensor, "views 3 4"]:
    """Return the inverse poses.

    >>> turn = torch.tensor([[[0.0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0]]])
    >>> bool((inverted(inverted(turn)) == turn).all())
    True
    """
    turned = c2w[:, :, :3].mT
    return torch.cat([turned, -turned @ c2w[:, :, 3:]], dim=-1)


def axes(c2w: Float[Tensor, "views 3 4"], signs: tuple[float, float, float]) -> Float[Tensor, "views 3 4"]:
    """Return the poses with the signs of the columns right, up, back changed."""
    return torch.cat([c2w[:, :, :3] * c2w.new_tensor(signs), c2w[:, :, 3:]], dim=-1)


def transposed(c2w: Float[Tensor, "views 3 4"]) -> Float[Tensor, "views 3 4"]:
    """Return the poses with only their rotations transposed."""
    return torch.cat([c2w[:, :, :3].mT, c2w[:, :, 3:]], dim=-1)


def centers_for_translations(c2w: Float[Tensor, "views 3 4"]) -> Float[Tensor, "views 3 4"]:
    """Return the poses with the translation (world to camera, right, down, forward) in place of the center."""
    return torch.cat([c2w[:, :, :3], -axes(c2w, FLIP_YZ)[:, :, :3].mT @ c2w[:, :, 3:]], dim=-1)


def other_quaternions(c2w: Float[Tensor, "views 3 4"]) -> Float[Tensor, "views 3 4"]:
    """Return the poses if their quaternions (world to camera) are x, y, z, w instead of w, x, y, z."""
    turned = axes(c2w, FLIP_YZ)
    w2c = rotation_from_quaternion(quaternion_from_rotation(turned[:, :, :3].mT)[:, [3, 0, 1, 2]])
    translation = -turned[:, :, :3].mT @ turned[:, :, 3:]
    return axes(torch.cat([w2c.mT, -w2c.mT @ translation], dim=-1), FLIP_YZ)


def mirrored(c2w: Float[Tensor, "views 3 4"]) -> Float[Tensor, "views 3 4"]:
    """Return the poses of a world, and cameras, whose z axes point the other way."""
    signs = c2w.new_tensor([1.0, 1.0, -1.0])
    return axes(c2w * signs[:, None], (1.0, 1.0, -1.0))


def numeric_order(cameras: Cameras, names: tuple[str, ...]) -> Tensor:
    """Return each view's row if rows are sorted by the numbers in the names, not by the names as text."""
    digits = ["".join(c for c in name.rsplit("/", 1)[-1] if c.isdigit()) for name in names]
    by_number = sorted(range(len(names)), key=lambda view: (int(digits[view] or 0), names[view]))
    by_text = sorted(range(len(names)), key=lambda view: names[view])
    order = torch.arange(len(names), device=cameras.c2w.device)
    order[by_number] = torch.tensor(by_text)
    return order


def _poses(change: Callable[[Tensor], Tensor]) -> Callable[[Scene, Matches], tuple[Tensor, Matches]]:
    return lambda scene, matches: (change(scene.user_cameras.c2w), matches)


def _pictures(x: float, y: float) -> Callable[[Scene, Matches], tuple[Tensor, Matches]]:
    # Mirrored about the principal point: good enough for a decision.
    return lambda scene, matches: (
        scene.user_cameras.c2w,
        replace(matches, plane=matches.plane * matches.plane.new_tensor([x, y])),
    )


AXES = (
    Reading(
        "like OpenCV's or COLMAP's (right, down, forward) rather than OpenGL's (right, up, back)",
        "Set scene.axes=opencv, or negate the second and third column of every rotation.",
        _poses(lambda c2w: axes(c2w, FLIP_YZ)),
    ),
    Reading(
        "like world-to-camera rather than camera-to-world",
        "Set scene.poses=w2c, or invert every pose matrix.",
        _poses(inverted),
    ),
    Reading(
        "like world-to-camera with OpenCV's axes (as COLMAP writes them)",
        "Set scene.poses=w2c scene.axes=opencv, or invert every pose matrix, then negate the second and third column of"
        " its rotation.",
        _poses(lambda c2w: axes(inverted(c2w), FLIP_YZ)),
    ),
    Reading(
        "like world-to-camera of cameras whose y and z axes were negated",
        "Negate the second and third column of every rotation, then invert every pose matrix.",
        _poses(lambda c2w: inverted(axes(c2w, FLIP_YZ))),
    ),
    Reading(
        "as if their rotations were transposed", "Transpose every rotation, leave the centers.", _poses(transposed)
    ),
    Reading(
        "as if their rotations were transposed, with OpenCV's axes",
        "Transpose every rotation, then negate its second and third column.",
        _poses(lambda c2w: axes(transposed(c2w), FLIP_YZ)),
    ),
    Reading(
        "as if the cameras' x and y axes were negated",
        "Negate columns 1 and 2 of every rotation.",
        _poses(lambda c2w: axes(c2w, (-1.0, -1.0, 1.0))),
    ),
    Reading(
        "as if the cameras' x and z axes were negated",
        "Negate columns 1 and 3 of every rotation.",
        _poses(lambda c2w: axes(c2w, (-1.0, 1.0, -1.0))),
    ),
    Reading(
        "as if their quaternions were x, y, z, w, and not w, x, y, z",
        "Write the quaternions as w, x, y, z.",
        _poses(other_quaternions),
    ),
    Reading(
        "as if the cameras' centers stood in the place of translations",
        "Write the translation -R c in the place of each center c (R is the rotation, world to camera).",
        _poses(centers_for_translations),
    ),
    Reading(
        "like those of a left-handed world (Unity's)",
        "Negate the third row and the third column of every pose matrix.",
        _poses(mirrored),
    ),
)
"""Of the poses."""
PHOTOGRAPHS = (
    Reading("as if the photographs were mirrored, left to right", "Mirror them back.", _pictures(-1.0, 1.0)),
    Reading(
        "as if the photographs were mirrored, top to bottom",
        "Flip the photographs top to bottom.",
        _pictures(1.0, -1.0),
    ),
)
"""Of the photographs."""
ORDERS = (
    Reading(
        "as if they followed the numbers in the photographs' names, and not the names sorted as text",
        "Pair photographs and poses in numeric order (rename 1.jpg to 0001.jpg and so on).",
        lambda scene, matches: (scene.user_cameras.c2w[numeric_order(scene.cameras, scene.view_names)], matches),
    ),
    Reading("as if each photograph had the pose of the next one", SHIFT, _poses(lambda c2w: c2w.roll(-1, 0))),
    Reading("as if each photograph had the pose of the previous one", SHIFT, _poses(lambda c2w: c2w.roll(1, 0))),
    Reading(
        "as if the photographs' order were reversed",
        "Reverse the list of photographs.",
        _poses(lambda c2w: c2w.flip(0)),
    ),
)
"""Of the assignment of poses to photographs."""

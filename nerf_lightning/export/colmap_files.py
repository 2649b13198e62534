"""Cameras as the text files of a COLMAP model (colmap.github.io/format.html)."""

from collections.abc import Sequence

import torch

from nerf_lightning.escaping import for_colmap
from nerf_lightning.geometry.poses import quaternion_from_rotation
from nerf_lightning.types.scene import Cameras

# Of the coefficients k1, k2, k3, k4, p1, p2: those that each of COLMAP's models takes, in its order.
MODELS = {
    "pinhole": ("PINHOLE", ()),
    "radial_tangential": ("OPENCV", (0, 1, 4, 5)),
    "fisheye": ("OPENCV_FISHEYE", (0, 1, 2, 3)),
}


def beyond_colmap(cameras: Cameras) -> str | None:
    """Return why COLMAP has no model for a lens, or None where it has."""
    if cameras.lens_model == "radial_tangential" and bool(cameras.lens[:, 2:4].any()):
        return "The lens has the coefficients k3 or k4, which COLMAP's model OPENCV lacks."
    return None


def colmap_files(cameras: Cameras, names: Sequence[str]) -> dict[str, str]:
    """Return name -> text; views with the same intrinsics share a camera."""
    numbers: dict[str, int] = {}
    images = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of features (none)"]
    for view, name in enumerate(names):
        camera = numbers.setdefault(_camera(cameras, view), len(numbers) + 1)
        images += [
            f"{view + 1} {_pose(cameras, view)} {camera} {for_colmap(name)}",
            "",
        ]  # two lines each, whatever it is called
    lines = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS", *(f"{number} {text}" for text, number in numbers.items())]
    return {
        "cameras.txt": "\n".join(lines) + "\n",
        "images.txt": "\n".join(images) + "\n",
        "points3D.txt": "# POINT3D_ID X Y Z R G B ERROR TRACK (none)\n",
    }


def _camera(cameras: Cameras, view: int) -> str:
    model, lens = MODELS[cameras.lens_model]
    numbers = [*cameras.focal[view].tolist(), *cameras.center[view].tolist(), *cameras.lens[view, list(lens)].tolist()]
    return f"{model} {int(cameras.width[view])} {int(cameras.height[view])} {' '.join(map(repr, numbers))}"


def _pose(cameras: Cameras, view: int) -> str:
    """Return world-to-camera with axes right, down, forward: a quaternion and a translation."""
    c2w = cameras.c2w[view]
    rotation = (c2w[:, :3] * torch.tensor([1.0, -1.0, -1.0]).to(c2w)).mT
    translation = -rotation @ c2w[:, 3]
    return " ".join(map(repr, [*quaternion_from_rotation(rotation).tolist(), *translation.tolist()]))

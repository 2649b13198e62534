"""Panoramas: equirectangular pictures of all directions around a camera.

Axes are those of lenses (x right, y down, z forward). A position in the image is in radians: azimuth from forward to
the right, from -pi to pi, and depression below the horizon, from -pi / 2 at the top to pi / 2. So the focal length of a
whole panorama is width / (2 pi) and height / pi pixels.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.matmul_precision import disable_autocast
from nerf_lightning.nerf.types.scene import Cameras

# Beyond this angle from the horizon (80 degrees) a small sphere may appear as wide as the whole picture.
NEAR_POLE = math.radians(80.0)


def project_panorama(directions: Float[Tensor, "*rays 3"]) -> Float[Tensor, "*rays 2"]:
    """Return azimuth and depression of directions of any length, in radians.

    >>> project_panorama(torch.tensor([[0.0, 0.0, 2.0], [3.0, 0.0, 0.0], [0.0, -1.0, 0.0]])).rad2deg().round().tolist()
    [[0.0, 0.0], [90.0, 0.0], [0.0, -90.0]]
    """
    x, y, z = directions.unbind(dim=-1)
    return torch.stack([torch.atan2(x, z), torch.atan2(y, torch.hypot(x, z))], dim=-1)


def unproject_panorama(angles: Float[Tensor, "*rays 2"]) -> Float[Tensor, "*rays 3"]:
    """Return the unit directions at azimuth and depression; the inverse of `project_panorama`."""
    azimuth, depression = angles.unbind(dim=-1)
    level = depression.cos()
    return torch.stack([level * azimuth.sin(), depression.sin(), level * azimuth.cos()], dim=-1)


def panorama_stretches(directions: Float[Tensor, "*rays 3"]) -> Float[Tensor, "*rays 2"]:
    """Return a panorama's stretch of its surroundings: 1 vertically, 1 / cos(depression) horizontally."""
    level = torch.hypot(directions[..., 0], directions[..., 2]) / directions.norm(dim=-1)
    return torch.stack([torch.ones_like(level), 1.0 / level.clamp(min=1e-6)], dim=-1)


def panorama_footprint(
    cameras: Cameras, view: int, directions: Float[Tensor, "cells 3"], half_diagonal: float
) -> tuple[Float[Tensor, "cells"], Float[Tensor, "cells"], Float[Tensor, "cells"]]:
    """Return x, y and radius in pixels of the discs that contain spheres; see `footprints.footprint`.

    Near a pole or across the picture's seam, the radius reaches beyond the picture, as a part of the sphere does.

    Args:
        cameras: all views.
        view: index of the view.
        directions: vectors from the camera to the spheres' centers, in the lens's axes, scene units.
        half_diagonal: the spheres' radius in scene units.
    """
    distance = directions.norm(dim=-1)
    half_angle = torch.asin((half_diagonal / distance).clamp(max=0.5))
    angles = project_panorama(directions)
    at = angles * cameras.focal[view] + cameras.center[view]
    highest = angles[:, 1].abs() + half_angle
    # Horizontally: sin(azimuth) = sin(half_angle) / cos(depression) where the sphere is widest.
    around = torch.asin((half_angle.sin() / angles[:, 1].cos().clamp(min=1e-6)).clamp(max=1.0))
    radius = torch.maximum(cameras.focal[view, 0] * around, cameras.focal[view, 1] * half_angle)
    whole = cameras.width[view] + cameras.height[view]
    radius = torch.where(highest < NEAR_POLE, radius, whole.to(radius))
    return at[:, 0], at[:, 1], torch.where(distance > 2.0 * half_diagonal, radius, 0.0)


def panorama_cameras(c2w: Float[Tensor, "views 3 4"], width: int, height: int) -> Cameras:
    """Return cameras that see all directions, in pictures centered on their -z axis."""
    views = c2w.shape[0]
    return Cameras(
        c2w=c2w,
        focal=c2w.new_tensor([width / (2.0 * math.pi), height / math.pi]).repeat(views, 1),
        center=c2w.new_tensor([width / 2, height / 2]).repeat(views, 1),
        lens=c2w.new_zeros(views, 6),
        lens_model="equirectangular",
        width=torch.full((views,), width, dtype=torch.int64, device=c2w.device),
        height=torch.full((views,), height, dtype=torch.int64, device=c2w.device),
    )


@disable_autocast
def faces_of_panoramas(panoramas: Cameras) -> Cameras:
    """Return six pinhole cameras for each panorama, the faces of a cube: front, left, back, right, top and bottom."""
    around = [[[c, 0, s], [0, 1, 0], [-s, 0, c]] for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))]
    above = [[[1, 0, 0], [0, 0, -s], [0, s, 0]] for s in (1, -1)]
    turns = panoramas.c2w.new_tensor(around + above)
    c2w = torch.cat(
        [panoramas.c2w[:, None, :, :3] @ turns, panoramas.c2w[:, None, :, 3:].expand(-1, 6, -1, -1)], dim=-1
    )
    side = (panoramas.height // 2).clamp(min=1).repeat_interleave(6)
    half = (0.5 * side)[:, None].expand(-1, 2).to(c2w)
    return Cameras(
        c2w=c2w.flatten(0, 1),
        focal=half.clone(),
        center=half.clone(),
        lens=torch.zeros_like(panoramas.lens).repeat_interleave(6, dim=0),
        lens_model="pinhole",
        width=side,
        height=side.clone(),
    )

"""The working frame of a capture, and where along its rays content may lie."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.data.capture import Capture
from nerf_lightning.errors import InputError
from nerf_lightning.geometry.cameras import all_pixels, rays_through_pixels
from nerf_lightning.geometry.frames import (
    average_pose,
    focus_point,
    poses_from_user,
    similarity,
    unit_of,
    up_direction,
    upright_rotation,
)
from nerf_lightning.types import Cameras, Space

# The near plane lies at this share of the least depth (LLFF's bound factor).
NEAR_SHARE = 0.75
# Sparse points beyond these quantiles are taken for mistakes.
QUANTILES = (0.01, 0.99)
# Without sparse points, in units of the farthest camera's distance from the middle.
NEAR_BLIND, FAR_CONTRACTED, LEAST_NEAR = 0.05, 16.0, 0.01
# Of the cube that the ball of the cameras just holds.
UNIT_BALL_HALF = 3**-0.5


@dataclass(frozen=True)
class Extent:
    """Where content may lie."""

    to_user: Float[Tensor, "4 4"]
    """The working frame, float64."""
    near: Float[Tensor, "views"]
    far: Float[Tensor, "views"]
    aabb: Float[Tensor, "2 3"]
    ndc: Float[Tensor, "views 2"] | None


def extent_of(capture: Capture, cameras: Cameras, space: Space, near: float | None, far: float | None) -> Extent:
    """Return the frame and the extent that suit a space.

    Args:
        capture: in the user's frame, as are `cameras`.
        cameras: at the size of the pixels.
        space: which one.
        near: in the user's units, where the user knows better.
        far: likewise.
    """
    if space == "ndc":
        return _forward_facing(capture, cameras, near)
    focus = focus_point(cameras.c2w)
    # The farthest camera stands at distance 1.
    unit = float((cameras.c2w[:, :, 3] - focus).norm(dim=-1).max()) or 1.0
    to_user = similarity(upright_rotation(up_direction(cameras.c2w)).mT, focus, unit)
    found_near, found_far = _from_points(capture, cameras, to_user)
    nearest = found_near if near is None else torch.full_like(found_near, near / unit)
    if space == "bounded":
        return _bounded(cameras, to_user, nearest, None if far is None else far / unit)
    farthest = found_far if far is None else torch.full_like(found_far, far / unit)
    return Extent(to_user, nearest.float(), farthest.float(), _cube(UNIT_BALL_HALF), None)


def depths_of(capture: Capture, cameras: Cameras, view: int) -> Float[Tensor, "points"]:
    """Return how far in front of a view the sparse points lie that fall into its picture, in the user's units."""
    c2w = cameras.c2w[view]
    local = (capture.points - c2w[:, 3]) @ c2w[:, :3]
    depth = -local[:, 2]
    plane = torch.stack([local[:, 0], -local[:, 1]], dim=-1) / depth[:, None]
    at = plane * cameras.focal[view] + cameras.center[view]
    size = torch.stack([cameras.width[view], cameras.height[view]])
    return depth[(depth > 0) & ((at > 0) & (at < size)).all(dim=-1)]


def _cube(half: float) -> Float[Tensor, "2 3"]:
    return torch.tensor([[-half] * 3, [half] * 3])


def _from_points(capture: Capture, cameras: Cameras, to_user: Tensor) -> tuple[Tensor, Tensor]:
    # Distances of content per view, in scene units: from the sparse points where they are, else a guess that is wide.
    unit, views = unit_of(to_user), len(capture.views)
    near = torch.full((views,), NEAR_BLIND, dtype=torch.float64)
    far = torch.full((views,), FAR_CONTRACTED, dtype=torch.float64)
    if capture.bounds is not None:
        near = 0.5 * capture.bounds[:, 0] / unit
    for view in range(views):
        depths = depths_of(capture, cameras, view)
        if len(depths) >= 20:
            near[view] = 0.5 * float(torch.quantile(depths, QUANTILES[0])) / unit
    return near.clamp(min=LEAST_NEAR), far


def _bounded(cameras: Cameras, to_user: Tensor, near: Tensor, far: float | None) -> Extent:
    # The box that every camera sees whole: a ball around the middle, inside all their frames.
    poses = poses_from_user(cameras.c2w, to_user)
    distance = poses[:, :, 3].norm(dim=-1)
    half_size = torch.stack([cameras.width, cameras.height], dim=-1) / 2
    tangent = (half_size / cameras.focal).amax(dim=-1).double()
    radius = float((distance * tangent / (1.0 + tangent.square()).sqrt()).min())
    half = min(radius, 0.95 * float(distance.min()))
    reach = 3**0.5 * half
    far_each = distance + reach if far is None else torch.full_like(distance, far)
    near_each = torch.maximum(near, (distance - reach).clamp(min=LEAST_NEAR))
    return Extent(to_user, torch.minimum(near_each, 0.5 * far_each).float(), far_each.float(), _cube(half), None)


def _forward_facing(capture: Capture, cameras: Cameras, near: float | None) -> Extent:
    # LLFF's frame: the average camera looks along -z; the unit is such that the near plane lies at z = -1.
    mean = average_pose(cameras.c2w)
    depths = [depths_of(capture, cameras, view) for view in range(len(capture.views))]
    if near is not None:
        nearest = near / NEAR_SHARE
    elif capture.bounds is not None:
        nearest = float(capture.bounds.min())
    else:
        nearest = min((float(torch.quantile(d, QUANTILES[0])) for d in depths if len(d) >= 20), default=0.0)
    if nearest <= 0:
        raise InputError(
            f"scene.space=ndc needs the depth at which content begins, and {capture.source} has neither "
            "bounds nor enough sparse points in its pictures. Give scene.near in the capture's units, or use "
            "scene.space=contracted."
        )
    to_user = similarity(mean[:, :3], mean[:, 3], NEAR_SHARE * nearest)
    half_size = torch.stack([cameras.width, cameras.height], dim=-1) / 2
    scale = (cameras.focal / half_size).median(dim=0).values.float()
    ndc = scale.expand(len(capture.views), 2).contiguous()
    moved = replace(cameras, c2w=poses_from_user(cameras.c2w, to_user).float(), ndc=ndc)
    corners, length = _corners(moved)
    margin = torch.tensor([0.01, 0.01, 0.0])
    aabb = torch.stack([corners.amin(dim=0) - margin, corners.amax(dim=0) + margin])
    aabb[:, 2] = torch.tensor([-1.0, 1.0])
    views = len(capture.views)
    return Extent(to_user, torch.zeros(views), length.expand(views).clone(), aabb, ndc)


def _corners(cameras: Cameras) -> tuple[Float[Tensor, "points 3"], Float[Tensor, ""]]:
    # Where the rays of all pictures' edges begin and end in the cube, and the longest way between.
    ends, longest = [], []
    zeros = torch.zeros(cameras.c2w.shape[0])
    for view in range(cameras.c2w.shape[0]):
        pixels = all_pixels(cameras, view)
        edge = torch.ones_like(pixels.x, dtype=torch.bool)
        edge[1:-1, 1:-1] = False
        rays = rays_through_pixels(cameras, pixels[edge], zeros, zeros + 1.0)
        ends += [rays.origins, rays.origins + rays.far[:, None] * rays.directions]
        longest.append(rays.far.max())
    return torch.cat(ends), torch.stack(longest).max()

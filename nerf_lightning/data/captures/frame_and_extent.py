"""The space that is modeled, the working frame of a capture, and the extent of content along its rays.

Up, middle and unit: `nerf/geometry/world_frame.py`.
"""

from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nerf_lightning.data.captures.capture import Capture
from nerf_lightning.data.captures.checks import FARTHEST
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.boxes import center_and_half
from nerf_lightning.nerf.geometry.cameras import coarse_pixels, rays_through_pixels
from nerf_lightning.nerf.geometry.world_frame import (
    FORWARD_FACING,
    LARGEST_UNIT,
    LEAST_UNIT,
    average_pose,
    least_agreement,
    middle_of_cameras,
    points_from_user,
    poses_from_user,
    similarity,
    unit_of,
    up_direction,
    upright_rotation,
)
from nerf_lightning.nerf.types.scene import Cameras, Space

# The near plane is at this share of the minimum depth (LLFF's bound factor).
NEAR_SHARE = 0.75
# Sparse points beyond these quantiles of the depths in a picture are treated as mistakes; fewer points say nothing.
QUANTILES, FEWEST_POINTS = (0.01, 0.99), 20
# If there are more sparse points, an evenly spaced subset is used for each view.
MOST_POINTS = 20_000
# Factors of those quantiles: content may begin before the nearest point, and continue behind the farthest.
NEAR_MARGIN, FAR_MARGIN = 0.5, 2.0
# Margin around the sparse points on each side of their box, as a share of it.
BOX_MARGIN = 0.1
# Times the median camera's distance from the center: a camera that is farther away is a reconstruction mistake.
FARTHEST_CAMERA = 3.0
# Without sparse points, in units of the farthest camera's distance from the center.
NEAR_BLIND, FAR_CONTRACTED, LEAST_NEAR = 0.05, 16.0, 0.01
# Cameras closer together than this share of their coordinates, which may be a map's, are at the same place.
ONE_PLACE = 1e-9
# Of the cube inscribed in the cameras' ball.
UNIT_BALL_HALF = 3**-0.5
# Minimum cosine between a pixel's ray and the cameras' mean direction: at 0 it would never reach infinity in normalized
# device coordinates.
LEAST_AHEAD = 0.1


def choose_space(
    requested: Space | Literal["auto"],
    cameras: Cameras,
    capture: Capture,
    has_transparency: bool,
    near: float | None = None,
) -> tuple[Space, str]:
    """Return the space and the reason; refuse NDC if it cannot work. `near` is as for `extent_of`."""
    cosine, ahead = least_agreement(cameras.c2w), least_ahead(cameras) > LEAST_AHEAD
    if requested == "ndc" and not ahead:
        raise InputError(
            f"scene.space=ndc needs cameras that all look the same way, but some pixels of {capture.source} look "
            "sideways or back. Use scene.space=contracted, or auto."
        )
    if requested != "auto":
        return requested, "as asked"
    if has_transparency:
        return "bounded", "since the pictures have transparent pixels: nothing lies behind the content"
    if ahead and cosine > FORWARD_FACING and (capture.bounds is not None or len(capture.points)):
        if near is None and _nearest_depth(capture, cameras) is None:
            return (
                "contracted",
                "since the cameras look the same way, but too few sparse points tell depths",
            )
        try:
            _near_plane(capture, cameras, near)
        except InputError:
            return "contracted", "since the cameras look the same way, but some stand behind what others show"
        depths = "the capture gives" if capture.bounds is not None else "sparse points give"
        return "ndc", f"since all cameras look the same way and {depths} depths"
    return "contracted", "since the photographs show a background"


def least_ahead(cameras: Cameras) -> float:
    """Return the minimum cosine between a pixel's ray and the cameras' mean direction, over a coarse grid of pixels."""
    cameras = replace(cameras, c2w=cameras.c2w.float())
    zeros = torch.zeros(cameras.c2w.shape[0])
    rays = rays_through_pixels(cameras, coarse_pixels(cameras), zeros, zeros)
    return float((rays.directions @ -functional.normalize(cameras.c2w[:, :, 2].mean(dim=0), dim=0)).min())


@dataclass(frozen=True)
class Extent:
    """Where content may be."""

    to_user: Float[Tensor, "4 4"]
    """The working frame, float64."""
    near: Float[Tensor, "views"]
    far: Float[Tensor, "views"]
    aabb: Float[Tensor, "2 3"]
    ndc: Float[Tensor, "views 2"] | None


def extent_of(capture: Capture, cameras: Cameras, space: Space, near: float | None, far: float | None) -> Extent:
    """Return the frame and the extent that suit a space.

    Capture and cameras (at the size of the pixels) are in the user's frame; `near` and `far` are overrides in the
    user's units.

    Raises:
        InputError: all cameras are at one position, near and far leave nothing, or the space does not suit the cameras.
    """
    _check_places(capture, cameras)
    if space == "ndc":
        return _forward_facing(capture, cameras, near, far)
    focus = middle_of_cameras(cameras)
    # The farthest camera is at distance 1, except for those that have drifted away.
    distance = (cameras.c2w[:, :, 3] - focus).norm(dim=-1)
    unit = float(torch.minimum(distance.max(), FARTHEST_CAMERA * distance.median()))
    to_user = similarity(upright_rotation(up_direction(cameras.c2w)).mT, focus, unit)
    nearest, farthest = _from_points(capture, cameras, to_user)
    aabb = _cube(UNIT_BALL_HALF)
    if space == "bounded":
        aabb = _box(capture, cameras, to_user)
        nearest, farthest = _around_box(cameras, to_user, aabb, nearest)
    # The user's values take precedence.
    if far is not None:
        farthest = torch.full_like(farthest, far / unit)
    nearest = torch.full_like(nearest, near / unit) if near is not None else torch.minimum(nearest, 0.5 * farthest)
    if near is not None and not bool((nearest < farthest).all()):
        raise InputError(
            f"scene.near={near:g} lies behind all content of {capture.source}, which ends at "
            f"{float(farthest.min()) * unit:.4g} in the capture's units. Give a smaller one, or scene.far too."
        )
    return Extent(to_user, nearest.float(), farthest.float(), aabb, None)


def given_extent(capture: Capture, near: float | None, far: float | None, aabb_half: float | None) -> Extent:
    """Return the extent given by files and settings, in the capture's own frame.

    Raises:
        InputError: near, far or the box is not given.
    """
    box = capture.box if aabb_half is None else _cube(aabb_half)
    if near is None or far is None or box is None:
        raise InputError(
            "scene.coordinates=given needs the distances between which content lies and its box, and "
            f"{capture.source} does not give them. Set scene.near, scene.far and scene.aabb_half, for example "
            "scene.near=2 scene.far=6 scene.aabb_half=1.5, or use scene.coordinates=fitted."
        )
    views = len(capture.views)
    eye = torch.eye(4, dtype=torch.float64)
    return Extent(eye, torch.full((views,), float(near)), torch.full((views,), float(far)), box.float(), None)


def require_possible(extent: Extent, to_user: Float[Tensor, "4 4"], capture: Capture) -> None:
    """Refuse an extent that no checkpoint could store, which results from wrong numbers in the capture.

    `to_user` transforms the working frame into the frame of the capture's author.

    Raises:
        InputError: content exceeds the numerical range, its box is empty, or the frame's unit is invalid.
    """
    reach = torch.cat([extent.near, extent.far, extent.aabb.flatten()]).abs().max()
    if not float(reach) <= FARTHEST:  # NaN, too
        raise InputError(
            f"{capture.source}: the content (its depths, its sparse points or its box) would reach {float(reach):g} "
            "times the cameras' distance from the middle, which must be an error of the reconstruction. Remove what "
            "lies so far away, or export the capture again."
        )
    if not bool((extent.aabb[0] < extent.aabb[1]).all() and (extent.near < extent.far).all()):
        raise InputError(
            f"{capture.source}: all of the content lies in one plane or at one distance, so the scene has no volume. "
            "Add scene.space=contracted, or remove what describes the content (sparse points, aabb_scale)."
        )
    unit = unit_of(to_user.double())
    if not (LEAST_UNIT <= unit <= LARGEST_UNIT and bool(torch.isfinite(to_user).all())):
        raise InputError(
            f"{capture.source} describes its cameras in a frame whose unit is {unit:g} of its maker's, which is "
            "implausible. Fix applied_scale and applied_transform, or the cameras' distances."
        )


def depths_of(capture: Capture, cameras: Cameras, view: int) -> Float[Tensor, "points"]:
    """Return the depths of the sparse points in a view's picture, in the user's units."""
    c2w = cameras.c2w[view]
    points = capture.points[:: 1 + len(capture.points) // MOST_POINTS]
    local = (points - c2w[:, 3]) @ c2w[:, :3]
    depth = -local[:, 2]
    plane = torch.stack([local[:, 0], -local[:, 1]], dim=-1) / depth[:, None]
    at = plane * cameras.focal[view] + cameras.center[view]
    size = torch.stack([cameras.width[view], cameras.height[view]])
    return depth[(depth > 0) & ((at > 0) & (at < size)).all(dim=-1)]


def _check_places(capture: Capture, cameras: Cameras) -> None:
    centers = cameras.c2w[:, :, 3]
    spread = (centers - centers.mean(dim=0)).abs().max()
    if float(spread) <= ONE_PLACE * float(centers.abs().max()):
        raise InputError(
            f"All {len(capture.views)} cameras of {capture.source} are at the same position, so they contain "
            "no information about depth. Photograph from several positions, or estimate the poses again."
        )


def _cube(half: float) -> Float[Tensor, "2 3"]:
    return torch.tensor([[-half] * 3, [half] * 3])


def _from_points(capture: Capture, cameras: Cameras, to_user: Tensor) -> tuple[Tensor, Tensor]:
    # Distances of content per view, in scene units: from the sparse points if there are any, else a wide guess.
    unit, views = unit_of(to_user), len(capture.views)
    near = torch.full((views,), NEAR_BLIND, dtype=torch.float64)
    far = torch.full((views,), FAR_CONTRACTED, dtype=torch.float64)
    if capture.bounds is not None:
        near, far = NEAR_MARGIN * capture.bounds[:, 0] / unit, FAR_MARGIN * capture.bounds[:, 1] / unit
    for view in range(views):
        depths = depths_of(capture, cameras, view)
        if len(depths) >= FEWEST_POINTS:
            ends = torch.quantile(depths, depths.new_tensor(QUANTILES)) / unit
            near[view], far[view] = NEAR_MARGIN * ends[0], FAR_MARGIN * ends[1]
    return near.clamp(min=LEAST_NEAR), far.clamp(min=FAR_CONTRACTED)


def _box(capture: Capture, cameras: Cameras, to_user: Tensor) -> Float[Tensor, "2 3"]:
    """Return the box that the format names, or the sparse points' bounding box, or what the cameras see."""
    if capture.box is not None:
        corners = points_from_user(torch.cartesian_prod(*capture.box.mT), to_user)
        return torch.stack([corners.amin(dim=0), corners.amax(dim=0)]).float()
    if len(capture.points) >= FEWEST_POINTS:
        points = points_from_user(capture.points[:: 1 + len(capture.points) // MOST_POINTS], to_user)
        # Symmetric, so that it does not depend on the direction of the user's x axis.
        level = (1.0 + BOX_MARGIN) * torch.quantile(points[:, :2].norm(dim=-1), QUANTILES[1])
        low, high = torch.quantile(points[:, 2], points.new_tensor(QUANTILES))
        room = BOX_MARGIN * (high - low)
        return torch.stack(
            [torch.stack([-level, -level, low - room]), torch.stack([level, level, high + room])]
        ).float()
    # A ball around the center that fills the longer side of the closest picture.
    distance = poses_from_user(cameras.c2w, to_user)[:, :, 3].norm(dim=-1)
    half_size = torch.stack([cameras.width, cameras.height], dim=-1) / 2
    tangent = (half_size / cameras.focal).amax(dim=-1).double()
    radius = float((distance * tangent / (1.0 + tangent.square()).sqrt()).min())
    return _cube(min(radius, 0.95 * float(distance.min())))


def _around_box(cameras: Cameras, to_user: Tensor, aabb: Tensor, near: Tensor) -> tuple[Tensor, Tensor]:
    # Near and far of rays that begin before the box and end behind it.
    center, half = center_and_half(aabb.double())
    distance = (poses_from_user(cameras.c2w, to_user)[:, :, 3] - center).norm(dim=-1)
    return torch.maximum(near, distance - half.norm()), distance + half.norm()


def _forward_facing(capture: Capture, cameras: Cameras, near: float | None, far: float | None) -> Extent:
    # LLFF's frame: the average camera looks along -z; the unit is such that the near plane is at z = -1.
    if far is not None:
        raise InputError(
            f"scene.far={far:g} cannot be used with scene.space=ndc, which reaches to infinity. Leave it out, or use "
            "scene.space=contracted or bounded."
        )
    mean, plane = average_pose(cameras.c2w), _near_plane(capture, cameras, near)
    to_user = similarity(mean[:, :3], mean[:, 3], plane)
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


def _near_plane(capture: Capture, cameras: Cameras, near: float | None) -> float:
    """Return the distance from the cameras' center to the near plane of NDC; refuse one that a camera is behind."""
    mean = average_pose(cameras.c2w)
    plane = near
    if plane is None:
        nearest = _nearest_depth(capture, cameras)
        if nearest is None:
            raise InputError(
                f"scene.space=ndc needs the depth at which content begins, and {capture.source} has neither "
                "bounds nor enough sparse points in its pictures. Give scene.near in the capture's units, or use "
                "scene.space=contracted."
            )
        plane = NEAR_SHARE * nearest
    ahead = -(cameras.c2w[:, :, 3] - mean[:, 3]) @ mean[:, 2]
    if float(ahead.max()) >= plane:
        view = capture.views[int(ahead.argmax())].name
        raise InputError(
            f"scene.space=ndc: the view {view} of {capture.source} stands {float(ahead.max()):.4g} ahead of the "
            f"cameras' middle, behind the near plane at {plane:.4g}, so what is in front of it would be lost. Use "
            "scene.space=contracted, or give a larger scene.near."
        )
    return plane


def _nearest_depth(capture: Capture, cameras: Cameras) -> float | None:
    """Return the depth at which content begins, from bounds or sparse points; None if there are neither."""
    if capture.bounds is not None:
        return float(capture.bounds.min())
    depths = [depths_of(capture, cameras, view) for view in range(len(capture.views))]
    found = [float(torch.quantile(each, QUANTILES[0])) for each in depths if len(each) >= FEWEST_POINTS]
    return min(found, default=None)


def _corners(cameras: Cameras) -> tuple[Float[Tensor, "points 3"], Float[Tensor, ""]]:
    # Where the rays of all pictures begin and end in the cube, and the longest distance between.
    zeros = torch.zeros(cameras.c2w.shape[0])
    rays = rays_through_pixels(cameras, coarse_pixels(cameras), zeros, zeros + 1.0).map(lambda x: x.flatten(0, 1))
    return torch.cat([rays.origins, rays.origins + rays.far[:, None] * rays.directions]), rays.far.max()

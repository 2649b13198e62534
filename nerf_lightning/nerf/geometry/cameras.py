"""Cameras and their rays: pixels to rays, rays to pixels, and resizing.

Letters: `c2w` camera-to-world, columns right, up, back, center. A camera looks along -z; pixel centers lie at +0.5.
`plane` is a position in the image in focal lengths from the principal point, y down: ((x - cx) / fx, (y - cy) / fy).

`kernels/rays/cuda.py` repeats `rays_through_pixels`.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.nerf.geometry.lenses import project_plane, stretches, unproject
from nerf_lightning.nerf.geometry.ndc import ndc_rays
from nerf_lightning.nerf.kernels.backends import with_kernel
from nerf_lightning.nerf.matmul_precision import disable_autocast
from nerf_lightning.nerf.types.rays import PixelIndex, RayBundle
from nerf_lightning.nerf.types.scene import Cameras

SAME_CAMERA = ("focal", "center", "lens", "width", "height")
"""Photographs that agree in all of these were taken with one camera."""


def which_camera(cameras: Cameras) -> Int[Tensor, "views"]:
    """Return the number of the camera that took each photograph, from 0."""
    kinds = [getattr(cameras, name).double().view(len(cameras.width), -1) for name in SAME_CAMERA]
    return torch.unique(torch.cat(kinds, dim=1), dim=0, return_inverse=True)[1]


def focal_from_fov(width: int | float, fov: float) -> float:
    """Return the focal length in pixels of a camera that sees `fov` radians across `width` pixels.

    >>> round(focal_from_fov(800, 0.6911112070083618), 2)
    1111.11
    """
    return 0.5 * width / math.tan(0.5 * fov)


def pinhole_cameras(c2w: Float[Tensor, "views 3 4"], focal: float, width: int, height: int) -> Cameras:
    """Return cameras without a lens that share one focal length (pixels) and one size, centered on the image."""
    views = c2w.shape[0]
    return Cameras(
        c2w=c2w,
        focal=c2w.new_full((views, 2), focal),
        center=c2w.new_tensor([width / 2, height / 2]).repeat(views, 1),
        lens=c2w.new_zeros(views, 6),
        lens_model="pinhole",
        width=torch.full((views,), width, dtype=torch.int64, device=c2w.device),
        height=torch.full((views,), height, dtype=torch.int64, device=c2w.device),
    )


def vertical_field_of_view(cameras: Cameras, view: int) -> float:
    """Return the vertical field of view of a view, in radians; for a panorama, pi / 2."""
    if cameras.lens_model == "equirectangular":
        return 0.5 * math.pi
    return 2 * float(torch.atan(0.5 * cameras.height[view] / cameras.focal[view, 1]))


def resized(cameras: Cameras, width: Int[Tensor, "*views"], height: Int[Tensor, "*views"]) -> Cameras:
    """Return the same cameras for images of another size: focal length and principal point scale with the pixels.

    The lens is unchanged: its coefficients are in focal lengths.
    """
    scale = torch.stack([width / cameras.width, height / cameras.height], dim=-1).to(cameras.focal)
    return replace(cameras, focal=cameras.focal * scale, center=cameras.center * scale, width=width, height=height)


@disable_autocast
@with_kernel("rays.cuda")
def rays_through_pixels(
    cameras: Cameras,
    pixels: PixelIndex,
    near: Float[Tensor, "views"],
    far: Float[Tensor, "views"],
    subpixel_offset: Float[Tensor, "*#rays 2"] | None = None,
    per_side: int = 1,
) -> RayBundle:
    """Return the rays through pixels; near and far are given per view (scene units).

    The direction in camera axes is ((x + 0.5 - cx) / fx, -(y + 0.5 - cy) / fy, -1), undistorted if the camera has a
    lens, rotated into the world and normalized. If the cameras say so, the ray is then mapped to normalized device
    coordinates, and near and far with it.

    Args:
        cameras: one per view.
        pixels: the pixels.
        near: where the rays of each view begin.
        far: where they end.
        subpixel_offset: each ray's offset from the center of its pixel, in pixels (x, y); None: none.
        per_side: number of rays along each side of a pixel.
    """
    view = pixels.view
    at = torch.stack([pixels.x, pixels.y], dim=-1).to(cameras.focal) + 0.5
    if subpixel_offset is not None:
        at = at + subpixel_offset
    plane = (at - cameras.center[view]) / cameras.focal[view]
    if cameras.lens_model == "pinhole":
        local = torch.stack([plane[..., 0], -plane[..., 1], -torch.ones_like(plane[..., 0])], dim=-1)
    else:
        local = _turned(unproject(plane, cameras.lens[view], cameras.lens_model))
    c2w = cameras.c2w[view]
    directions = (c2w[..., :3] @ local[..., None])[..., 0]
    directions = directions / directions.norm(dim=-1, keepdim=True)
    side = pixel_side(cameras, view, _turned(local)) / per_side
    rays = RayBundle(c2w[..., 3], directions, near[view], far[view], view_directions=directions, pixel_side=side)
    return rays if cameras.ndc is None else ndc_rays(rays, cameras.ndc[view])


@torch.no_grad()
def pixel_side(
    cameras: Cameras, view: Int[Tensor, "*rays"], directions: Float[Tensor, "*rays 3"]
) -> Float[Tensor, "*rays 2"]:
    """Return the side of pixels (the root of their area) at distance 0, and its growth per unit of distance.

    A pinhole's pixel takes the solid angle cos^3 / (f_x f_y); a lens that stretches its surroundings shows less in it.
    In normalized device coordinates, pixels seen from the middle of all cameras have the same size at all depths.
    Without gradients: the size of its pixels is no reason to move a camera.

    Args:
        cameras: all views.
        view: the view of each pixel.
        directions: of the pixels' centers in the lens's axes (right, down, forward), of any length.
    """
    pixel = 1.0 / cameras.focal[view]
    if cameras.ndc is not None:
        side = (cameras.ndc[view] * pixel).prod(dim=-1).sqrt()
        return torch.stack([side, torch.zeros_like(side)], dim=-1)
    area = pixel.prod(dim=-1)
    if cameras.lens_model != "pinhole":
        area = area / stretches(directions, cameras.lens[view], cameras.lens_model).prod(dim=-1)
    if cameras.lens_model in ("pinhole", "radial_tangential"):
        area = area * (directions[..., 2] / directions.norm(dim=-1)) ** 3
    side = area.clamp(min=0.0).sqrt()
    return torch.stack([torch.zeros_like(side), side], dim=-1)


def all_pixels(cameras: Cameras, view: int) -> PixelIndex:
    """Return the indices of all pixels of one view, shape (height, width), which take no memory."""
    width, height = int(cameras.width[view]), int(cameras.height[view])
    across, down = (torch.arange(side, device=cameras.c2w.device) for side in (width, height))
    shape = (height, width)
    return PixelIndex(across.new_tensor(view).expand(shape), across.expand(shape), down[:, None].expand(shape))


def pixels_between(cameras: Cameras, view: int, part: slice) -> PixelIndex:
    """Return a range of pixels of one view, numbered row by row from 0."""
    number = torch.arange(part.start, part.stop, device=cameras.c2w.device)
    width = int(cameras.width[view])
    return PixelIndex(view=torch.full_like(number, view), x=number % width, y=number // width)


def coarse_pixels(cameras: Cameras, per_side: int = 9) -> PixelIndex:
    """Return a coarse grid of pixels in every view, including corners and borders, shape (views, pixels)."""
    share = torch.linspace(0.0, 1.0, per_side, dtype=torch.float64, device=cameras.c2w.device)
    across, down = torch.cartesian_prod(share, share).unbind(dim=-1)
    x, y = ((size - 1)[:, None] * part for size, part in ((cameras.width, across), (cameras.height, down)))
    view = torch.arange(cameras.c2w.shape[0], device=x.device)[:, None].expand(x.shape)
    return PixelIndex(view=view, x=x.round().long(), y=y.round().long())


@disable_autocast
def camera_coordinates(cameras: Cameras, view: int, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
    """Return world points in the axes of one camera: right, up, back."""
    c2w = cameras.c2w[view]
    return (points - c2w[:, 3]) @ c2w[:, :3]


def project(cameras: Cameras, view: int, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 2"]:
    """Return where world points appear in one view, in pixels from the upper left corner (x, y).

    Only points that the camera sees have a position: elsewhere (behind a pinhole, far outside the image of a lens that
    folds back there) the result is meaningless.
    """
    local = camera_coordinates(cameras, view, points)
    if cameras.lens_model == "pinhole":
        plane = torch.stack([local[..., 0], -local[..., 1]], dim=-1) / -local[..., 2:]
    else:
        plane = project_plane(_turned(local), cameras.lens[view], cameras.lens_model)
    return plane * cameras.focal[view] + cameras.center[view]


def seen_at(
    cameras: Cameras, view: int, points: Float[Tensor, "points 3"]
) -> tuple[Bool[Tensor, "points"], Int[Tensor, "points"], Int[Tensor, "points"]]:
    """Return which world points are inside the picture of one view, and in which of its pixels (x, y; 0 if outside).

    Occlusion is ignored.
    """
    pixel = project(cameras, view, points)
    inside = (camera_coordinates(cameras, view, points)[:, 2] < 0) | (cameras.lens_model == "equirectangular")
    inside &= (pixel >= 0).all(dim=-1) & (pixel[:, 0] < cameras.width[view]) & (pixel[:, 1] < cameras.height[view])
    x, y = torch.where(inside[:, None], pixel, 0.0).long().unbind(dim=-1)
    return inside, x, y


def image_plane(cameras: Cameras, view: int, per_side: int = 33) -> Float[Tensor, "points 2"]:
    """Return a coarse grid over one image, including its border and corners, as positions in the plane."""
    x, y = (
        torch.linspace(0.5, float(size[view]) - 0.5, per_side).to(cameras.focal)
        for size in (cameras.width, cameras.height)
    )
    return (torch.cartesian_prod(x, y) - cameras.center[view]) / cameras.focal[view]


def _turned(directions: Float[Tensor, "*rays 3"]) -> Float[Tensor, "*rays 3"]:
    # From a camera's axes (right, up, back) to those of its lens (right, down, forward), or back.
    x, y, z = directions.unbind(dim=-1)
    return torch.stack([x, -y, -z], dim=-1)


def at_most(cameras: Cameras, longest: int) -> Cameras:
    """Return the cameras for pictures whose longer side has at most `longest` pixels."""
    share = (longest / torch.maximum(cameras.width, cameras.height)).clamp(max=1.0)
    width, height = ((share * size).round().long().clamp(min=1) for size in (cameras.width, cameras.height))
    return resized(cameras, width, height)

"""Cameras and their rays: pixels to rays, rays to pixels, focal lengths that follow the image's size.

Letters: `c2w` camera-to-world, columns right, up, back, centre. A camera looks along -z; pixel centres lie at +0.5.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.types import Cameras, PixelIndex, RayBundle


def focal_from_fov(width: int, fov: float) -> float:
    """Return the focal length in pixels of a camera that sees `fov` radians across `width` pixels.

    >>> round(focal_from_fov(800, 0.6911112070083618), 2)
    1111.11
    """
    return 0.5 * width / math.tan(0.5 * fov)


def pinhole_cameras(c2w: Float[Tensor, "views 3 4"], focal: float, width: int, height: int) -> Cameras:
    """Return cameras that share one focal length (pixels) and one size, with the principal point in the middle."""
    views = c2w.shape[0]
    return Cameras(
        c2w=c2w,
        focal=c2w.new_full((views, 2), focal),
        center=c2w.new_tensor([width / 2, height / 2]).repeat(views, 1),
        width=torch.full((views,), width, dtype=torch.int64, device=c2w.device),
        height=torch.full((views,), height, dtype=torch.int64, device=c2w.device),
    )


def resized(cameras: Cameras, width: Int[Tensor, "*views"], height: Int[Tensor, "*views"]) -> Cameras:
    """Return the same cameras for images of another size: focal length and principal point follow the pixels."""
    scale = torch.stack([width / cameras.width, height / cameras.height], dim=-1).to(cameras.focal)
    return Cameras(
        c2w=cameras.c2w,
        focal=cameras.focal * scale,
        center=cameras.center * scale,
        width=width,
        height=height,
    )


def rays_through_pixels(
    cameras: Cameras,
    pixels: PixelIndex,
    near: Float[Tensor, "views"],
    far: Float[Tensor, "views"],
) -> RayBundle:
    """Return the rays through the centres of pixels; near and far are given per view (scene units).

    The direction in camera axes is ((x + 0.5 - cx) / fx, -(y + 0.5 - cy) / fy, -1), rotated into the world and
    brought to unit length.
    """
    view = pixels.view
    at = torch.stack([pixels.x, pixels.y], dim=-1).to(cameras.focal) + 0.5
    plane = (at - cameras.center[view]) / cameras.focal[view]
    local = torch.stack([plane[..., 0], -plane[..., 1], -torch.ones_like(plane[..., 0])], dim=-1)
    c2w = cameras.c2w[view]
    directions = (c2w[..., :3] @ local[..., None])[..., 0]
    return RayBundle(
        origins=c2w[..., 3],
        directions=directions / directions.norm(dim=-1, keepdim=True),
        near=near[view],
        far=far[view],
        camera_index=view,
    )


def all_pixels(cameras: Cameras, view: int) -> PixelIndex:
    """Return every pixel of one view as a picture of indices, shape (height, width)."""
    device = cameras.c2w.device
    y, x = torch.meshgrid(
        torch.arange(int(cameras.height[view]), device=device),
        torch.arange(int(cameras.width[view]), device=device),
        indexing="ij",
    )
    return PixelIndex(view=torch.full_like(x, view), x=x, y=y)


def camera_coordinates(cameras: Cameras, view: int, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
    """Return world points in the axes of one camera: right, up, back."""
    c2w = cameras.c2w[view]
    return (points - c2w[:, 3]) @ c2w[:, :3]


def project(cameras: Cameras, view: int, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 2"]:
    """Return where world points appear in one view, in pixels from the upper left corner (x, y)."""
    local = camera_coordinates(cameras, view, points)
    plane = torch.stack([local[..., 0], -local[..., 1]], dim=-1) / -local[..., 2:]
    return plane * cameras.focal[view] + cameras.center[view]

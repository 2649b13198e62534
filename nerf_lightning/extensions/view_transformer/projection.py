"""Project points along rays into other photographs.

A ray appears as a line (the epipolar line): in the axes of a source camera its point at distance t is a + t b, with a
the ray's origin and b its direction. So each ray is transformed into each camera once, instead of each point.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.nerf.geometry.cameras import coarse_pixels
from nerf_lightning.nerf.geometry.lenses import project_plane, unproject
from nerf_lightning.nerf.matmul_precision import disable_autocast
from nerf_lightning.nerf.types.rays import RayBundle
from nerf_lightning.nerf.types.scene import Cameras
from nerf_lightning.nerf.types.tensor_struct import TensorStruct

LEAST_COSINE = 1e-3
"""Minimum cosine of the angle from a pinhole's axis: points to the side of the camera are not in its picture."""
BEYOND = 1.1
"""Factor beyond the widest angle in a picture up to which its lens is valid; farther out it may fold back."""


@dataclass(frozen=True)
class Projected(TensorStruct):
    """Points of rays in their source photographs."""

    xy: Float[Tensor, "rays samples sources 2"]
    """In pixels from the upper left corner; 0 if not visible."""
    visible: Bool[Tensor, "rays samples sources"]
    """Whether the point is in the picture."""
    turned: Float[Tensor, "rays samples sources 4"]
    """The direction of the ray to the point relative to the source's: the difference of directions, and their dot
    product."""


@disable_autocast
def project_samples(
    cameras: Cameras,
    least_cosine: Float[Tensor, "views"],
    views: Int[Tensor, "rays sources"],
    rays: RayBundle,
    t: Float[Tensor, "rays samples"],
) -> Projected:
    """Return the projections of the points at distances t along rays, as in `geometry.cameras.project`.

    Args:
        cameras: of the photographs.
        least_cosine: as returned by `seen_cosines`.
        views: the cameras of each ray's sources.
        rays: in the world.
        t: distances.
    """
    c2w, t = cameras.c2w[views], t[:, :, None, None]
    apart = rays.origins[:, None] - c2w[..., 3]
    # From a camera's axes (right, up, back) to its lens's (right, down, forward).
    axes = torch.cat([c2w[..., :1], -c2w[..., 1:3]], dim=-1)
    start = (apart[..., None, :] @ axes)[..., 0, :]
    along = (rays.directions[:, None, None, :] @ axes)[..., 0, :]
    local = start[:, None] + t * along[:, None]
    distance = local.square().sum(dim=-1).clamp(min=1e-12).sqrt()
    ahead = local[..., 2] > least_cosine[views][:, None] * distance
    in_front = torch.where(ahead[..., None], local, torch.eye(3, device=local.device, dtype=local.dtype)[2])
    plane = project_plane(in_front, cameras.lens[views][:, None], cameras.lens_model)
    xy = plane * cameras.focal[views][:, None] + cameras.center[views][:, None]
    size = torch.stack([cameras.width[views], cameras.height[views]], dim=-1)[:, None]
    visible = ahead & ((xy >= 0.0) & (xy <= size)).all(dim=-1)
    looks = rays.directions[:, None, None, :]
    source_looks = (apart[:, None] + t * looks) / distance[..., None]
    turned = torch.cat([looks - source_looks, (looks * source_looks).sum(dim=-1, keepdim=True)], dim=-1)
    return Projected(torch.where(visible[..., None], xy, 0.0), visible, turned)


@disable_autocast
def seen_cosines(cameras: Cameras) -> Float[Tensor, "views"]:
    """Return the cosine of the widest angle from the axis that each camera's picture shows.

    The angle is slightly wider than that of its pixels; for panoramas the cosine is -1.
    """
    if cameras.lens_model == "pinhole":
        return torch.full_like(cameras.focal[:, 0], LEAST_COSINE)
    if cameras.lens_model == "equirectangular":
        return torch.full_like(cameras.focal[:, 0], -2.0)
    pixels = coarse_pixels(cameras)
    at = torch.stack([pixels.x, pixels.y], dim=-1).to(cameras.focal) + 0.5
    plane = (at - cameras.center[:, None]) / cameras.focal[:, None]
    directions = torch.nn.functional.normalize(unproject(plane, cameras.lens[:, None], cameras.lens_model), dim=-1)
    cosine = (BEYOND * directions[..., 2].clamp(-1.0, 1.0).acos().amax(dim=1)).clamp(max=torch.pi).cos()
    return cosine if cameras.lens_model == "fisheye" else cosine.clamp(min=LEAST_COSINE)

"""Normalized device coordinates for forward-facing captures (Appendix C, arXiv 2003.08934).

The frustum in front of the near plane z = -1 becomes the cube from -1 to 1: straight lines stay straight, the far end
of the world becomes z = 1, and equal steps along a ray are equal steps of disparity.

Which captures are modeled in them: `choose_space` in data/captures/frame_and_extent.py.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.types.rays import RayBundle

# No ray points sideways or back: it would never reach the far plane.
LEAST_FORWARD = 1e-3
# Bounds 1 / gap, the expected depth of light from infinity in units of the near plane's distance.
LEAST_GAP = 2e-3


def ndc_points(points: Float[Tensor, "*points 3"], scale: Float[Tensor, "*#points 2"]) -> Float[Tensor, "*points 3"]:
    """Map points in front of the cameras: (-a_x x/z, -a_y y/z, 1 + 2/z); `scale` is a = focal / half the image's size.

    Eq. 25 and 26 of the paper, for near = 1 and far = infinity.

    >>> ndc_points(torch.tensor([[0.5, 0.0, -1.0], [0.0, 2.0, -4.0]]), torch.tensor([2.0, 2.0]))
    tensor([[ 1.0000,  0.0000, -1.0000],
            [ 0.0000,  1.0000,  0.5000]])
    """
    x, y, z = points.unbind(dim=-1)
    a_x, a_y = scale.unbind(dim=-1)
    return torch.stack([-a_x * x / z, -a_y * y / z, 1.0 + 2.0 / z], dim=-1)


def ndc_rays(rays: RayBundle, scale: Float[Tensor, "*#rays 2"]) -> RayBundle:
    """Return the rays as straight lines through the cube, from the near plane (distance 0) to infinity (`far`).

    Args:
        rays: in the world, looking along -z.
        scale: focal over half the image's size, along x and y.
    """
    origins, forward = _at_near_plane(rays)
    start = ndc_points(origins, scale)
    x, y, z = origins.unbind(dim=-1)
    a_x, a_y = scale.unbind(dim=-1)
    slope = rays.directions[..., :2] / forward[..., None]
    along = torch.stack([-a_x * (slope[..., 0] - x / z), -a_y * (slope[..., 1] - y / z), -2.0 / z], dim=-1)
    length = along.norm(dim=-1)
    return replace(rays, origins=start, directions=along / length[..., None], near=torch.zeros_like(length), far=length)


def world_distance(rays: RayBundle, share: Float[Tensor, "*rays"]) -> Float[Tensor, "*rays"]:
    """Return the distance along world rays of a point at `share` (0 to 1) of the way through the cube.

    At share s the disparity is 1/|z| = (1 - s) / |z_near|.
    """
    origins, forward = _at_near_plane(rays)
    before = ((origins - rays.origins) * rays.directions).sum(dim=-1)
    # z(t') = o_z / (1 - t'), and t' = 1 - o_z / (o_z + t d_z).
    gap = (1.0 - share).clamp(min=LEAST_GAP)
    return before + origins[..., 2] * (1.0 / gap - 1.0) / forward


def share_at_distance(rays: RayBundle, distance: Float[Tensor, "*rays"]) -> Float[Tensor, "*rays"]:
    """Return the share of the way through the cube at a distance along world rays; 0 before the near plane.

    The inverse of `world_distance`.
    """
    origins, forward = _at_near_plane(rays)
    before = ((origins - rays.origins) * rays.directions).sum(dim=-1)
    return 1.0 - 1.0 / (1.0 + (distance - before).clamp(min=0.0) * forward / origins[..., 2])


def _at_near_plane(rays: RayBundle) -> tuple[Float[Tensor, "*rays 3"], Float[Tensor, "*rays"]]:
    forward = rays.directions[..., 2].clamp(max=-LEAST_FORWARD)
    reach = -(1.0 + rays.origins[..., 2]) / forward
    origins = rays.origins + reach[..., None] * rays.directions
    # A clamped sideways ray must still start on the plane.
    return torch.cat([origins[..., :2], -torch.ones_like(origins[..., 2:])], dim=-1), forward

"""Where small spheres appear in a view: a disc of pixels that is sure to contain each."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.cameras import camera_coordinates, image_plane
from nerf_lightning.nerf.geometry.lenses import at_angle, off_axis, project_plane, stretches, unproject
from nerf_lightning.nerf.geometry.panoramas import panorama_footprint
from nerf_lightning.nerf.types.scene import Cameras


def footprint(
    cameras: Cameras, view: int, centers: Float[Tensor, "cells 3"], half_diagonal: float
) -> tuple[Float[Tensor, "cells"], Float[Tensor, "cells"], Float[Tensor, "cells"]]:
    """Return x, y and radius in pixels of the discs that contain what one view sees of spheres.

    The radius is 0 if the view does not see the sphere, or is too close to it to determine that.

    Args:
        cameras: all views.
        view: index of the view.
        centers: centers of the spheres, world axes, scene units.
        half_diagonal: the spheres' radius in scene units.
    """
    if cameras.lens_model == "pinhole":
        return _through_pinhole(cameras, view, centers, half_diagonal)
    local = camera_coordinates(cameras, view, centers)
    directions = local * local.new_tensor([1.0, -1.0, -1.0])
    if cameras.lens_model == "equirectangular":
        return panorama_footprint(cameras, view, directions, half_diagonal)
    return _through_lens(cameras, view, directions, half_diagonal)


def _through_pinhole(
    cameras: Cameras, view: int, centers: Tensor, half_diagonal: float
) -> tuple[Tensor, Tensor, Tensor]:
    # Sums are written out in the order of the compiled twin (kernels/carving/cpu.py), so that the bits agree.
    c2w = cameras.c2w[view]
    x, y, z = (centers - c2w[:, 3]).unbind(dim=-1)
    right, up, back = (x * axis[0] + y * axis[1] + z * axis[2] for axis in c2w[:, :3].unbind(dim=-1))
    depth = -back
    in_front = depth > 2.0 * half_diagonal
    safe = torch.where(in_front, depth, 1.0)
    x = cameras.focal[view, 0] * right / safe + cameras.center[view, 0]
    y = -cameras.focal[view, 1] * up / safe + cameras.center[view, 1]
    # A sphere off the axis appears elongated: by no more than its ray's length over its depth, squared.
    stretch = ((right.square() + up.square() + depth.square()) / safe.square()).clamp(max=9.0)
    radius = cameras.focal[view].max() * half_diagonal / (safe - half_diagonal).clamp(min=half_diagonal) * stretch
    return x, y, torch.where(in_front, radius, 0.0)


def _through_lens(
    cameras: Cameras, view: int, directions: Tensor, half_diagonal: float
) -> tuple[Tensor, Tensor, Tensor]:
    lens, model = cameras.lens[view], cameras.lens_model
    widest = off_axis(unproject(image_plane(cameras, view), lens, model))[0].max()
    distance = directions.norm(dim=-1)
    half_angle = torch.asin((half_diagonal / distance).clamp(max=0.5))
    angle, heading = off_axis(directions)
    # Outside the image the formulas may fold back into it, so points there are moved to its rim.
    inner, middle, outer = ((angle + side * half_angle).clamp(min=0.0).clamp(max=widest) for side in (-1, 0, 1))
    at = project_plane(at_angle(middle, heading), lens, model) * cameras.focal[view] + cameras.center[view]
    # A lens stretches smoothly: over a small sphere, the maximum at three positions along the radius is enough.
    across = at_angle(torch.stack([inner, middle, outer]), heading.expand(3, -1, -1))
    most = stretches(across, lens, model)[..., 1].amax(dim=0)
    per_radian = most if model == "fisheye" else most / outer.cos().square()
    radius = cameras.focal[view].max() * half_angle * per_radian
    in_view = (distance > 2.0 * half_diagonal) & (angle - half_angle < widest)
    return at[:, 0], at[:, 1], torch.where(in_view, radius, 0.0)

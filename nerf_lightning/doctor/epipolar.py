"""Check poses against matched places: each must lie on the epipolar line of the other's ray.

What share of them must: SOUND and HOPELESS in `poses.py`.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from nerf_lightning.doctor.matches import Matches

TOLERANCE = 1.5  # Pixels of the shrunk pictures


def agreeing(matches: Matches, c2w: Float[Tensor, "views 3 4"], zoom: float = 1.0) -> Bool[Tensor, "matches"]:
    """Return which matches the poses explain: rays that meet, within `TOLERANCE`, in front of both cameras.

    Focal lengths are multiplied by `zoom`.
    """
    ahead = (_nearest(*rays_of(matches, c2w, zoom)) > 0).all(dim=-1)
    return ahead & (line_distances(matches, c2w, zoom) < TOLERANCE).all(dim=-1)


def line_distances(matches: Matches, c2w: Float[Tensor, "views 3 4"], zoom: float = 1.0) -> Float[Tensor, "matches 2"]:
    """Return the distance of each place from the epipolar line of the other's ray, in pixels of the shrunk pictures.

    With D, E the rays and b the vector between the centers, the plane of b and E intersects the other picture in a line
    (the epipolar line). Hartley and Zisserman, "Multiple View Geometry", 2004, chapter 9. Arguments as in `agreeing`.
    """
    rays, baseline = rays_of(matches, c2w, zoom)
    off = []
    for here, there in ((0, 1), (1, 0)):
        normal = functional.normalize(torch.linalg.cross(baseline, rays[:, there]), dim=-1)
        # The line in the axes of the picture: its first two components are in the picture's plane.
        right, up, back = c2w[matches.view[:, here], :, :3].double().unbind(dim=-1)
        slope = ((normal * right).sum(dim=-1).square() + (normal * up).sum(dim=-1).square()).sqrt()
        depth = -(rays[:, here] * back).sum(dim=-1)
        apart = (normal * rays[:, here]).sum(dim=-1).abs() / (depth * slope).clamp(min=1e-6)
        off.append(apart * matches.focal[:, here] * zoom)
    return torch.stack(off, dim=-1)


def distances(matches: Matches, c2w: Float[Tensor, "views 3 4"]) -> Float[Tensor, "matches 2"]:
    """Return the distances of each match along both rays, where the rays are closest to each other (scene units).

    Unreliable if the rays are nearly parallel: see `parallax`.
    """
    return _nearest(*rays_of(matches, c2w)).float()


def places(matches: Matches, c2w: Float[Tensor, "views 3 4"]) -> Float[Tensor, "matches 3"]:
    """Return the world position of each match, on the first ray (scene units)."""
    rays, baseline = rays_of(matches, c2w)
    first = c2w[matches.view[:, 0], :, 3].double()
    return (first + _nearest(rays, baseline)[:, :1] * rays[:, 0]).float()


def parallax(matches: Matches, c2w: Float[Tensor, "views 3 4"]) -> Float[Tensor, "matches"]:
    """Return the angle between the two rays of each match, in radians."""
    rays, _ = rays_of(matches, c2w)
    return torch.linalg.cross(rays[:, 0], rays[:, 1]).norm(dim=-1).clamp(max=1).asin().float()


def rays_of(
    matches: Matches, c2w: Float[Tensor, "views 3 4"], zoom: float = 1.0
) -> tuple[Float[Tensor, "matches 2 3"], Float[Tensor, "matches 3"]]:
    """Return unit rays of both ends, and the vector from the first camera to the second (scene units)."""
    plane = matches.plane.double() / zoom
    local = torch.stack([plane[..., 0], -plane[..., 1], -torch.ones_like(plane[..., 0])], dim=-1)
    poses = c2w[matches.view].double()
    # Written out: a matrix product per match is slow.
    rays = functional.normalize((poses[..., :3] * local[..., None, :]).sum(dim=-1), dim=-1)
    return rays, poses[:, 1, :, 3] - poses[:, 0, :, 3]


def _nearest(rays: Float[Tensor, "matches 2 3"], baseline: Float[Tensor, "matches 3"]) -> Float[Tensor, "matches 2"]:
    # s, t that minimize |s first - t second - baseline|.
    first, second = rays.unbind(dim=1)
    cosine = (first * second).sum(dim=-1)
    along, across = (first * baseline).sum(dim=-1), (second * baseline).sum(dim=-1)
    sine = (1.0 - cosine.square()).clamp(min=1e-12)
    return torch.stack([along - cosine * across, cosine * along - across], dim=-1) / sine[:, None]

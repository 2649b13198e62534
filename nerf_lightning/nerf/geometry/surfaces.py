"""Surfaces as depth maps: the depth of the light that was stopped, and the surface's normals."""

import math
from itertools import product

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize, pad

from nerf_lightning.nerf.row_chunks import row_chunks

_SEEN = 1e-3
"""Opacity below which a ray met nothing: the rest of its depth is rounding."""
REACH, SIGMA = 2, 1.5
"""Pixels on each side that a normal is computed from, and the width of their weights."""
LEAST_ALIKE = 1e-4
"""Weight of pixels that seem to be on another surface: if all are, a plane through them is better than none."""


def surface_depth(
    depth: Float[Tensor, "*rays"], opacity: Float[Tensor, "*rays"], far: Float[Tensor, "*rays"]
) -> Float[Tensor, "*rays"]:
    """Return the expected distance of the light that was stopped: (depth - (1 - opacity) far) / opacity.

    A rendering's depth counts light that escapes at far; this removes its share. A ray that met nothing (opacity below
    0.001) ends at far.
    """
    met = opacity > _SEEN
    return torch.where(met, (depth - (1 - opacity) * far) / torch.where(met, opacity, 1.0), far)


def normals_from_depth(points: Float[Tensor, "height width 3"]) -> Float[Tensor, "height width 3"]:
    """Return unit normals, facing the camera, of a surface given as each pixel's point (world axes).

    Each pixel has the normal of a plane through the 5 x 5 pixels around it, by weighted least squares; zero if they are
    on a line. Differences of neighbors alone show the depth's ripples, whose length is a cell of the field, and go
    wrong wherever a neighbor sees another surface. So nearby pixels count more (a Gaussian), and so do those whose
    points are as far apart as on one surface: s pixels away, s times as far as the second nearest of the four
    neighbors,

        w = exp(-s^2 / (2 sigma^2)) exp(-((|p_k - p| - s gap) / gap)^2).

    With row 0 on top, (slope down the rows) x (slope along the columns) points toward the camera for whatever a
    pinhole sees, so no pose is needed. The picture must be at least two pixels high and wide.
    """
    normals, height = torch.empty_like(points), points.shape[0]
    for rows in row_chunks(*points.shape[:2]):
        top, bottom = max(0, rows.start - REACH), min(height, rows.stop + REACH)
        normals[rows] = _normals(points[top:bottom])[rows.start - top : rows.stop - top]
    return normals


def _normals(points: Float[Tensor, "height width 3"]) -> Float[Tensor, "height width 3"]:
    height, width, _ = points.shape
    around = pad(points, (0, 0, REACH, REACH, REACH, REACH), value=torch.nan)

    def away(down: int, along: int) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width"]]:
        top, left = REACH + down, REACH + along
        way = around[top : top + height, left : left + width] - points
        return way, way.norm(dim=-1)

    gaps = (away(*step)[1].nan_to_num(nan=torch.inf) for step in ((-1, 0), (1, 0), (0, -1), (0, 1)))
    gap = torch.stack(list(gaps)).kthvalue(2, dim=0).values.clamp(min=torch.finfo(points.dtype).tiny)
    total, total_down, total_along = (torch.zeros_like(gap) for _ in range(3))
    mean, down_slope, along_slope = (torch.zeros_like(points) for _ in range(3))
    for down, along in product(range(-REACH, REACH + 1), repeat=2):
        way, apart = away(down, along)
        steps = math.hypot(down, along)
        alike = torch.exp(-(apart / gap - steps).square()) + LEAST_ALIKE
        weight = torch.where(apart.isfinite(), math.exp(-0.5 * (steps / SIGMA) ** 2) * alike, 0.0)
        weighted = way.nan_to_num_(nan=0.0, posinf=0.0, neginf=0.0).mul_(weight[..., None])
        for sums, each in (((total, total_down, total_along), weight), ((mean, down_slope, along_slope), weighted)):
            sums[0].add_(each)
            sums[1].add_(each, alpha=down)
            sums[2].add_(each, alpha=along)
    # The slopes are these covariances times a positive matrix, which keeps the direction of their cross product.
    down_slope.sub_((total_down / total)[..., None] * mean).div_(gap[..., None])
    along_slope.sub_((total_along / total)[..., None] * mean).div_(gap[..., None])
    return normalize(torch.linalg.cross(down_slope, along_slope), dim=-1)

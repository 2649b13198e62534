"""How close the shape is, for scenes that know theirs: error of the depth and of the normals."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

_SEEN = 1e-3
"""Opacity below which a ray met nothing: what is left of its depth is rounding."""


def surface_depth(
    depth: Float[Tensor, "*rays"], opacity: Float[Tensor, "*rays"], far: Float[Tensor, "*rays"]
) -> Float[Tensor, "*rays"]:
    """Return the expected distance of the light that was stopped: (depth - (1 - opacity) far) / opacity.

    A rendering's depth lets the light that escapes end at far; here its share is taken out. A ray that met
    nothing (opacity below 0.001) ends at far.
    """
    met = opacity > _SEEN
    return torch.where(met, (depth - (1 - opacity) * far) / torch.where(met, opacity, 1.0), far)


def depth_error(
    depth: Float[Tensor, "*rays"],
    opacity: Float[Tensor, "*rays"],
    far: Float[Tensor, "*rays"],
    truth_depth: Float[Tensor, "*rays"],
    alpha: Float[Tensor, "*rays"],
) -> float | None:
    """Return the mean absolute error of the depth (scene units) over pixels that the scene covers wholly.

    Args:
        depth: expected distance along the ray, where light that escapes ends at far.
        opacity: share of the light that was stopped.
        far: where each ray ends.
        truth_depth: true distance along the ray; inf where there is none.
        alpha: true coverage of the pixel, in [0, 1]. At an edge there is no one true depth, so only 1 counts.

    Returns:
        The error, or None if no pixel can be scored. A hole in the surface counts with depth far.
    """
    scored = _opaque(alpha) & truth_depth.isfinite()
    if not scored.any():
        return None
    return float((surface_depth(depth, opacity, far) - truth_depth)[scored].abs().mean())


def normals_from_depth(points: Float[Tensor, "height width 3"]) -> Float[Tensor, "height width 3"]:
    """Return unit normals, facing the camera, of a surface given as each pixel's point (world axes).

    The cross product of central differences, one-sided at the border; zero where they are parallel. With row
    0 on top, (down the rows) x (along the columns) points towards the camera for whatever a pinhole sees, so
    no pose is needed. The picture must be at least two pixels high and wide.
    """
    down, along = torch.gradient(points, dim=(0, 1))
    return normalize(torch.linalg.cross(down, along), dim=-1)


def normal_error(
    normals: Float[Tensor, "height width 3"],
    truth_normals: Float[Tensor, "height width 3"],
    alpha: Float[Tensor, "height width"],
) -> float | None:
    """Return the mean angle in degrees between unit normals; None if no pixel can be scored.

    A pixel counts if it and its four neighbours are wholly covered by the scene (`alpha` 1): the differences
    that make its normal then touch no background. The border, which lacks a neighbour, does not count.
    """
    scored = _well_inside(_opaque(alpha)) & (truth_normals.norm(dim=-1) > 0)
    if not scored.any():
        return None
    ours, true = normals[scored], truth_normals[scored]
    # atan2 keeps its precision at small angles, where acos of a dot product near 1 loses half the digits.
    angle = torch.atan2(torch.linalg.cross(ours, true).norm(dim=-1), (ours * true).sum(dim=-1))
    return float(torch.rad2deg(angle).mean())


def _well_inside(covered: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    inside = torch.zeros_like(covered)
    above_and_below = covered[:-2, 1:-1] & covered[2:, 1:-1]
    beside = covered[1:-1, :-2] & covered[1:-1, 2:]
    inside[1:-1, 1:-1] = covered[1:-1, 1:-1] & above_and_below & beside
    return inside


def _opaque(alpha: Float[Tensor, "*rays"]) -> Bool[Tensor, "*rays"]:
    """Tell the pixels that are wholly covered by the scene, where geometry can be scored."""
    return alpha >= 1.0

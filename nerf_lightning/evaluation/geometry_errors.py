"""Errors of depth and normals, for scenes with known geometry."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.surfaces import surface_depth


def depth_error(
    depth: Float[Tensor, "*rays"],
    opacity: Float[Tensor, "*rays"],
    far: Float[Tensor, "*rays"],
    truth_depth: Float[Tensor, "*rays"],
    alpha: Float[Tensor, "*rays"],
) -> float | None:
    """Return the mean absolute error of the depth (scene units) over pixels that the scene fully covers.

    Args:
        depth: expected distance along the ray, where light that escapes ends at far.
        opacity: share of the light that was stopped.
        far: distance at which each ray ends.
        truth_depth: true distance along the ray; inf where there is none.
        alpha: true coverage of the pixel, in [0, 1]. At an edge there is no single true depth, so only 1 counts.

    Returns:
        The error, or None if no pixel can be scored. A hole in the surface counts with depth far.
    """
    scored = (alpha >= 1.0) & truth_depth.isfinite()
    if not scored.any():
        return None
    return float((surface_depth(depth, opacity, far) - truth_depth)[scored].abs().mean())


def normal_error(
    normals: Float[Tensor, "height width 3"],
    truth_normals: Float[Tensor, "height width 3"],
    alpha: Float[Tensor, "height width"],
) -> float | None:
    """Return the mean angle in degrees between unit normals; None if no pixel can be scored.

    A pixel counts if the scene fully covers it and its four neighbors (`alpha` 1): the differences that make its normal
    then touch no background. The border, which lacks a neighbor, does not count.
    """
    covered, inside = alpha >= 1.0, torch.zeros_like(alpha, dtype=torch.bool)
    above_and_below = covered[:-2, 1:-1] & covered[2:, 1:-1]
    beside = covered[1:-1, :-2] & covered[1:-1, 2:]
    inside[1:-1, 1:-1] = covered[1:-1, 1:-1] & above_and_below & beside
    scored = inside & (truth_normals.norm(dim=-1) > 0)
    if not scored.any():
        return None
    ours, true = normals[scored], truth_normals[scored]
    # atan2 keeps its precision at small angles, where acos of a dot product near 1 loses half the digits.
    angle = torch.atan2(torch.linalg.cross(ours, true).norm(dim=-1), (ours * true).sum(dim=-1))
    return float(torch.rad2deg(angle).mean())

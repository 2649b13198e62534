"""The cones of pixels: the extent of the space that one sample represents (Sec. 3.1, arXiv 2103.13415).

A pixel is not a line. Between two distances its cone is approximated by a normal distribution, with sigma_t along the
ray and sigma_r across. A covariance is stored as its six entries xx, yy, zz, xy, xz, yz.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.matmul_precision import disable_autocast

ROWS, COLUMNS = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
UNIFORM_VARIANCE = 1.0 / 12.0
"""Variance of a uniform distribution over a unit of length."""


def cone_covariance(
    directions: Float[Tensor, "*#points 3"], along: Float[Tensor, "*points"], across: Float[Tensor, "*points"]
) -> Float[Tensor, "*points 6"]:
    """Return Sigma = sigma_t^2 d d^T + sigma_r^2 (1 - d d^T), with the variances of uniform distributions.

    Args:
        directions: the rays' directions, unit length.
        along: length of each sample's interval.
        across: side of the pixel at the sample.

    >>> cone_covariance(torch.tensor([0.0, 0.0, 1.0]), torch.tensor(6.0), torch.tensor(0.0)).tolist()
    [0.0, 0.0, 3.0, 0.0, 0.0, 0.0]
    """
    of_ray, of_pixel = UNIFORM_VARIANCE * along.square(), UNIFORM_VARIANCE * across.square()
    outer = directions[..., ROWS] * directions[..., COLUMNS]
    isotropic = outer.new_tensor([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    return (of_ray - of_pixel)[..., None] * outer + of_pixel[..., None] * isotropic


def scaled_covariance(covariance: Float[Tensor, "*points 6"], scale: Float[Tensor, "3"]) -> Float[Tensor, "*points 6"]:
    """Return the covariances after scaling the axes of space."""
    return covariance * (scale[ROWS] * scale[COLUMNS])


@disable_autocast
def contracted_covariance(
    covariance: Float[Tensor, "*points 6"], positions: Float[Tensor, "*points 3"]
) -> Float[Tensor, "*points 6"]:
    """Return J Sigma J^T, J the Jacobian of `contraction.contract` at the positions (Sec. 3, arXiv 2111.12077).

    Outside the unit ball, lengths along the radius r shrink by 1 / r^2, those around it by (2 - 1/r) / r.
    """
    radius = positions.norm(dim=-1, keepdim=True).clamp(min=1.0)
    around, outward = (2.0 - 1.0 / radius) / radius, 1.0 / radius.square()
    heading = positions / positions.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    jacobian = (outward - around)[..., None] * heading[..., :, None] * heading[..., None, :]
    jacobian = jacobian + around[..., None] * torch.eye(3, dtype=positions.dtype, device=positions.device)
    return from_matrix(jacobian @ to_matrix(covariance) @ jacobian)


def to_matrix(covariance: Float[Tensor, "*points 6"]) -> Float[Tensor, "*points 3 3"]:
    """Return the entries as symmetric matrices."""
    return covariance[..., [0, 3, 4, 3, 1, 5, 4, 5, 2]].unflatten(-1, (3, 3))


def from_matrix(matrices: Float[Tensor, "*points 3 3"]) -> Float[Tensor, "*points 6"]:
    """Return the six entries of symmetric matrices."""
    return matrices[..., ROWS, COLUMNS]

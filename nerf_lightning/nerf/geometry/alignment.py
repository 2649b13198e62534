"""Two sets of poses of the same cameras, each in a frame and scale of its own: the similarity between them."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.world_frame import poses_from_user, similarity
from nerf_lightning.nerf.matmul_precision import disable_autocast

LEAST_SPREAD = 1e-6
"""Of the cameras' centers, as a share of their distance from the origin; below it they stand in one place."""


@disable_autocast
def similarity_between(one: Float[Tensor, "views 3 4"], other: Float[Tensor, "views 3 4"]) -> Float[Tensor, "4 4"]:
    """Return the similarity that takes the poses of `one` to those of `other`, by least squares, in float64.

    Umeyama's solution (PAMI 1991, Eq. 40-43), in which the cameras' axes count beside their centers, as much as the
    centers' spread: cameras that stand in a line, or two of them, leave no turn about that line open.
    """
    one, other = one.double(), other.double()
    middle, goal = one[:, :, 3].mean(dim=0), other[:, :, 3].mean(dim=0)
    source, target = one[:, :, 3] - middle, other[:, :, 3] - goal
    spread = source.square().sum(dim=1).mean()
    size = one[:, :, 3].square().sum(dim=1).mean().clamp(min=1e-30)
    in_place = bool(spread < LEAST_SPREAD**2 * size)
    axes = (other[:, :, :3] @ one[:, :, :3].mT).mean(dim=0)
    covariance = target.mT @ source / len(source) + (1.0 if in_place else spread) * axes
    left, _, right = torch.linalg.svd(covariance)
    sign = torch.ones(3, dtype=one.dtype, device=one.device)
    sign[2] = torch.linalg.det(left @ right)
    rotation = left @ torch.diag(sign) @ right
    turned = source @ rotation.mT
    scale = 1.0 if in_place else float((target * turned).sum() / source.square().sum())
    return similarity(rotation, goal - scale * rotation @ middle, scale)


@disable_autocast
def carried(c2w: Float[Tensor, "views 3 4"], by: Float[Tensor, "4 4"]) -> Float[Tensor, "views 3 4"]:
    """Return where a similarity (float64) takes poses."""
    return poses_from_user(c2w.double(), torch.linalg.inv(by)).to(c2w)

"""The similarity between two sets of poses of the same cameras, each in its own frame and scale."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.world_frame import poses_from_user, similarity
from nerf_lightning.nerf.matmul_precision import disable_autocast

LEAST_SPREAD = 1e-6
"""Minimum spread of the cameras' centers, as a share of their distance from the origin; below it they coincide."""


@disable_autocast
def similarity_between(one: Float[Tensor, "views 3 4"], other: Float[Tensor, "views 3 4"]) -> Float[Tensor, "4 4"]:
    """Return the least-squares similarity that maps the poses of `one` to those of `other`, in float64.

    Umeyama's solution (PAMI 1991, Eq. 40-43), in which the cameras' axes count as well as their centers, as much as the
    centers' spread: two cameras, or cameras in a line, leave no rotation about that line undetermined.
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
    """Return the poses mapped by a similarity (float64)."""
    return poses_from_user(c2w.double(), torch.linalg.inv(by)).to(c2w)

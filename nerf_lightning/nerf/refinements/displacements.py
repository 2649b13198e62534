"""What refined cameras imply: where views that were not trained on move to, and which cameras moved far."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.alignment import carried, similarity_between
from nerf_lightning.nerf.types.scene import Cameras

FAR = 5.0
"""Cameras that moved more than this many times the median moved far."""
LEAST_FAR = 5e-3
"""Smaller motions are never far: radians, or shares of the scene's extent."""


def align_untrained_cameras(initial: Cameras, learnt: Cameras, trained: Sequence[int]) -> Cameras:
    """Return the cameras as learned, with those that were not trained on moved by the trained ones' overall motion.

    The photographs do not determine the scene's position, size and rotation, so all trained cameras may have drifted
    together: the others follow by the similarity between the trained ones before and after.
    """
    rows = list(trained)
    c2w = carried(initial.c2w, similarity_between(initial.c2w[rows], learnt.c2w[rows]))
    c2w[rows] = learnt.c2w[rows]
    return replace(learnt, c2w=c2w)


def camera_displacements(
    initial: Cameras, learnt: Cameras, trained: Sequence[int], extent: float
) -> Float[Tensor, "trained"]:
    """Return how far each trained camera has moved, apart from the motion of all.

    This is its rotation angle (radians) plus its shift divided by the scene's extent.
    """
    rows = list(trained)
    before = carried(initial.c2w[rows], similarity_between(initial.c2w[rows], learnt.c2w[rows])).double()
    after = learnt.c2w[rows].double()
    # |R - R'|_F = 2 sqrt(2) sin(angle / 2), which is exact for small angles where the arc cosine is not.
    chord = (before[:, :, :3] - after[:, :, :3]).flatten(1).norm(dim=1)
    angle = 2.0 * torch.asin((chord / 8**0.5).clamp(max=1.0))
    return angle + (before[:, :, 3] - after[:, :, 3]).norm(dim=1) / extent


def far_displaced(motion: Float[Tensor, "trained"]) -> list[int]:
    """Return the indices of cameras that moved much farther than most, the farthest first.

    >>> far_displaced(torch.tensor([0.01, 0.012, 0.2, 0.009]))
    [2]
    """
    far = (motion > FAR * motion.median()) & (motion > LEAST_FAR)
    return [int(place) for place in motion.argsort(descending=True) if far[place]]

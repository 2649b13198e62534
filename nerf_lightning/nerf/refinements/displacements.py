"""What refined cameras say of those beside them: where views that were not trained on go, and who moved far."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.alignment import carried, similarity_between
from nerf_lightning.nerf.types.scene import Cameras

FAR = 5.0
"""So many times the median is far to have moved."""
LEAST_FAR = 5e-3
"""What is less is never far: radians, or shares of the scene's extent."""


def align_untrained_cameras(given: Cameras, learnt: Cameras, trained: Sequence[int]) -> Cameras:
    """Return the cameras as learned, and those that were not trained on where the trained ones have gone as a whole.

    Nothing in the photographs says where the scene is, how large, or turned how, so all trained cameras may have
    drifted alike: the others follow by the similarity between the trained ones before and after.
    """
    rows = list(trained)
    c2w = carried(given.c2w, similarity_between(given.c2w[rows], learnt.c2w[rows]))
    c2w[rows] = learnt.c2w[rows]
    return replace(learnt, c2w=c2w)


def camera_displacements(
    given: Cameras, learnt: Cameras, trained: Sequence[int], extent: float
) -> Float[Tensor, "trained"]:
    """Return how far each trained camera has moved, beside what all have moved as one.

    It is the angle that it has turned by (radians) plus its shift over the scene's extent.
    """
    rows = list(trained)
    before = carried(given.c2w[rows], similarity_between(given.c2w[rows], learnt.c2w[rows])).double()
    after = learnt.c2w[rows].double()
    # |R - R'|_F = 2 sqrt(2) sin(angle / 2), which is exact for small angles where the arc cosine is not.
    chord = (before[:, :, :3] - after[:, :, :3]).flatten(1).norm(dim=1)
    angle = 2.0 * torch.asin((chord / 8**0.5).clamp(max=1.0))
    return angle + (before[:, :, 3] - after[:, :, 3]).norm(dim=1) / extent


def far_displaced(motion: Float[Tensor, "trained"]) -> list[int]:
    """Return the places of those that moved several times as far as most, the farthest first.

    >>> far_displaced(torch.tensor([0.01, 0.012, 0.2, 0.009]))
    [2]
    """
    far = (motion > FAR * motion.median()) & (motion > LEAST_FAR)
    return [int(place) for place in motion.argsort(descending=True) if far[place]]

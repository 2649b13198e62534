"""How samples are spread along a ray that has no end: evenly up to distance 1, evenly in disparity beyond.

The cameras of a contracted scene stand within distance 1 of its middle, so what is photographed from all sides lies
in the even part. Seen from the middle, even steps are even steps of the contraction (Sec. 5, arXiv 2111.12077).
"""

import torch
from jaxtyping import Float
from torch import Tensor

TINY = 1e-6


def spread(distances: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """Map distances to [0, 1): t / 2 up to 1, then 1 - 1 / (2 t).

    >>> spread(torch.tensor([0.0, 0.5, 1.0, 2.0, torch.inf])).tolist()
    [0.0, 0.25, 0.5, 0.75, 1.0]
    """
    return torch.where(distances < 1.0, 0.5 * distances, 1.0 - 0.5 / distances.clamp(min=1.0))


def unspread(shares: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """Invert `spread`."""
    return torch.where(shares < 0.5, 2.0 * shares, 0.5 / (1.0 - shares).clamp(min=TINY))

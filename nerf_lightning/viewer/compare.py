"""Truth and render in one picture, and pictures in windows of another shape."""

import torch
from jaxtyping import UInt8
from torch import Tensor
from torch.nn.functional import pad

PAPER = 237
LINE = 255


def wiped(
    truth: UInt8[Tensor, "height width 3"], render: UInt8[Tensor, "height width 3"], share: float
) -> UInt8[Tensor, "height width 3"]:
    """Return the truth in the left `share` of the picture and the render in the rest, with a line between.

    >>> wiped(torch.zeros(1, 4, 3).byte(), torch.full((1, 4, 3), 9).byte(), 0.5)[0, :, 0].tolist()
    [0, 255, 9, 9]
    """
    cut = round(share * truth.shape[1])
    joined = torch.cat([truth[:, :cut], render[:, cut:]], dim=1)
    if 0 < cut < truth.shape[1]:
        joined[:, cut - 1] = LINE
    return joined


def in_window(picture: UInt8[Tensor, "height width 3"], aspect: float) -> UInt8[Tensor, "taller wider 3"]:
    """Return the picture in the middle of paper whose width over height is `aspect`.

    >>> in_window(torch.zeros(2, 2, 3).byte(), 2.0).shape
    torch.Size([2, 4, 3])
    """
    height, width, _ = picture.shape
    beside = max(0, round(height * aspect) - width)
    above = max(0, round(width / aspect) - height)
    edges = (0, 0, beside // 2, beside - beside // 2, above // 2, above - above // 2)
    return pad(picture, edges, value=PAPER)

"""Search in sorted numbers, in the way that suits the device."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.kernels.backends import is_on


def search(
    ordered: Float[Tensor, "*rays n"], numbers: Float[Tensor, "*rays m"], right: bool = False
) -> Int[Tensor, "*rays m"]:
    """Return how many of each row's `ordered` numbers are below each of `numbers`; with `right`, at most as large.

    XLA would send a binary search to the host and back. There each number is compared with all: the compiler fuses
    comparison and sum, so that nothing of that size is stored.

    >>> search(torch.tensor([1.0, 2.0, 2.0, 3.0]), torch.tensor([0.0, 2.0, 9.0])).tolist()
    [0, 1, 4]
    """
    if numbers.device.type != "xla" and is_on("searchsorted"):
        return torch.searchsorted(ordered.contiguous(), numbers.contiguous(), right=right)
    left, row = numbers[..., :, None], ordered[..., None, :]
    return (row <= left if right else row < left).sum(dim=-1)

"""Search in sorted numbers, in the way best for the device."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

# On other devices (XLA and later ones) the search would go to the host and back.
SEARCHING_DEVICES = ("cpu", "cuda", "mps")


def search(
    ordered: Float[Tensor, "*rays n"], numbers: Float[Tensor, "*rays m"], right: bool = False
) -> Int[Tensor, "*rays m"]:
    """Return how many of each row's `ordered` numbers are below each of `numbers`; with `right`, at most as large.

    >>> search(torch.tensor([1.0, 2.0, 2.0, 3.0]), torch.tensor([0.0, 2.0, 9.0])).tolist()
    [0, 1, 4]
    """
    if numbers.device.type in SEARCHING_DEVICES:
        return torch.searchsorted(ordered.contiguous(), numbers.contiguous(), right=right)
    return search_by_comparison(ordered, numbers, right)


def search_by_comparison(
    ordered: Float[Tensor, "*rays n"], numbers: Float[Tensor, "*rays m"], right: bool = False
) -> Int[Tensor, "*rays m"]:
    """Return the same by comparing all pairs; a compiler fuses comparison and sum, so no n x m array is stored.

    >>> search_by_comparison(torch.tensor([1.0, 2.0, 2.0, 3.0]), torch.tensor([0.0, 2.0, 9.0]), right=True).tolist()
    [0, 3, 4]
    """
    row, each = ordered[..., None, :], numbers[..., :, None]
    return (row <= each if right else row < each).sum(dim=-1)

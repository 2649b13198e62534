"""Rows of tables, such as the camera of each ray, whose gradients add up in the same order every time."""

from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional


def rows(table: Float[Tensor, "rows *row"], number: Int[Tensor, "*places"]) -> Float[Tensor, "..."]:
    """Return `table[number]`.

    The backward pass of indexing adds atomically where there are several threads, in an order that differs from run to
    run; that of an embedding lets each row be added up by one thread, so that a resumed run has the bits of one that
    never stopped.

    >>> import torch
    >>> rows(torch.tensor([[1.0, 2.0], [3.0, 4.0]]), torch.tensor([1, 0, 1])).tolist()
    [[3.0, 4.0], [1.0, 2.0], [3.0, 4.0]]
    """
    if not table.requires_grad:
        return table[number]
    return functional.embedding(number, table.flatten(1)).unflatten(-1, table.shape[1:])

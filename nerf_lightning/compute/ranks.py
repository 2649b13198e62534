"""The processes of a run: which one this is, and what they sum, exchange and agree on. A single one works alone.

`training.launch.processes` joins them; this module only asks torch.distributed whether it has. Each process (rank)
works on its share of the same global batch, and all of them know whatever one of them bases a decision on.
"""

import os
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor, distributed, nn

from nerf_lightning.messages.errors import InputError

Item = TypeVar("Item")
LARGE = 1 << 19
"""Number of elements above which a tensor is sent by itself."""


def world_size() -> int:
    """Return how many processes the run has."""
    return distributed.get_world_size() if distributed.is_initialized() else 1


def rank() -> int:
    """Return the index of this process, from 0."""
    return distributed.get_rank() if distributed.is_initialized() else 0


def is_first() -> bool:
    """Return whether this process logs and writes for all."""
    return rank() == 0


def share(count: int) -> slice:
    """Return this rank's part of `count` consecutive items; the parts are as equal as possible.

    >>> share(10)
    slice(0, 10, None)
    """
    return part_of(count, rank(), world_size())


def part_of(count: int, number: int, parts: int) -> slice:
    """Return part `number` of `parts`.

    >>> [part_of(10, number, 4) for number in range(4)]
    [slice(0, 3, None), slice(3, 6, None), slice(6, 8, None), slice(8, 10, None)]
    """
    size, rest = divmod(count, parts)
    start = number * size + min(number, rest)
    return slice(start, start + size + int(number < rest))


def every_other(items: Sequence[Item]) -> Sequence[Item]:
    """Return this rank's items when they are dealt out in turn."""
    return items[rank() :: world_size()]


def add_up(tensors: Iterable[Tensor]) -> None:
    """Replace each tensor with its sum over the ranks; all ranks get the same bits.

    Small tensors of one dtype share a message, which costs more than their bytes; copying a large one would cost more
    than a message.
    """
    if world_size() == 1:
        return
    pending, kinds = [], defaultdict[tuple[torch.dtype, torch.device], list[Tensor]](list)
    for tensor in tensors:
        if tensor.numel() > LARGE:
            pending.append(distributed.all_reduce(tensor, async_op=True))
        else:
            kinds[tensor.dtype, tensor.device].append(tensor)
    for several in kinds.values():
        sums = torch.cat([tensor.flatten() for tensor in several])
        distributed.all_reduce(sums)
        for tensor, part in zip(several, sums.split([tensor.numel() for tensor in several]), strict=True):
            tensor.copy_(part.view_as(tensor))
    for message in pending:
        message.wait()


def add_up_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """Replace the gradients with their sums over the ranks, once per step."""
    if world_size() == 1:
        return
    trained = [parameter for parameter in parameters if parameter.requires_grad]
    for parameter in trained:
        # Every rank must send the same tensors; parameters that no ray of this rank has reached have no gradient yet.
        if parameter.grad is None:
            parameter.grad = torch.zeros_like(parameter)
    add_up([parameter.grad for parameter in trained if parameter.grad is not None])


def average(tensors: Sequence[Tensor]) -> None:
    """Replace each tensor with its mean over the ranks."""
    if world_size() > 1:
        add_up(tensors)
        for tensor in tensors:
            tensor /= world_size()


def total(tensor: Tensor) -> Tensor:
    """Return the sum of a tensor over the ranks; with one rank, the tensor itself."""
    if world_size() == 1:
        return tensor
    result = tensor.clone()
    add_up([result])
    return result


def largest(value: float) -> float:
    """Return the largest value that any rank has."""
    if world_size() == 1:
        return value
    result = torch.tensor(value, dtype=torch.float64)
    distributed.all_reduce(result, op=distributed.ReduceOp.MAX)
    return float(result)


def gather(value: Item) -> list[Item]:
    """Return the values of all ranks, in rank order."""
    if world_size() == 1:
        return [value]
    values: list[Any] = [None] * world_size()
    distributed.all_gather_object(values, value)
    return values


def in_turn(items: Sequence[Item]) -> list[Item]:
    """Return all items in their original order, given each rank's `every_other`."""
    parts = gather(list(items))
    rounds = max(map(len, parts))
    return [part[number] for number in range(rounds) for part in parts if number < len(part)]


def from_first(make: Callable[[], Item]) -> Item:
    """Let the first rank make something, and return it on all ranks.

    Raises:
        InputError: what the first rank raised, on all ranks.
    """
    if world_size() == 1:
        return make()
    told: list[Any] = [None, None]
    if is_first():
        try:
            told[0] = make()
        except InputError as error:
            told[1] = str(error)
    distributed.broadcast_object_list(told, src=0)
    if told[1] is not None:
        raise InputError(told[1])
    return told[0]


def processes_here() -> int:
    """Return how many of the run's processes are on this machine."""
    if distributed.is_torchelastic_launched():
        return int(os.environ["LOCAL_WORLD_SIZE"])
    return int(os.environ["SLURM_NTASKS"]) // int(os.environ.get("SLURM_NNODES", "1"))

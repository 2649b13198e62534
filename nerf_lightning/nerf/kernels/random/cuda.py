"""Random numbers for CUDA, bit for bit those of `nerf.randomness`; `TRITON_INTERPRET=1` runs them without a GPU."""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.nerf.randomness import FEISTEL_ROUNDS, grid_of

BLOCK = 512


def uniform(
    keys: Int[Tensor, "rays"], slots: Int[Tensor, "rays"], purpose: int, count: int
) -> Float[Tensor, "rays {count}"]:
    """Return `count` numbers per ray, uniform on [0, 1)."""
    out = torch.empty(len(slots), count, device=slots.device)
    if out.numel():
        grid = (triton.cdiv(out.numel(), BLOCK),)
        _uniform[grid](keys.contiguous(), slots.contiguous(), out, purpose, out.numel(), count, BLOCK)
    return out


def in_order(first: int, count: int, size: int, key: int, device: torch.device | str) -> Int[Tensor, "{count}"]:
    """Return what stands at `count` places from `first` on, where `size` things follow each other anew in each epoch.

    Args:
        first: place.
        count: of places.
        size: of an epoch, whose order is `randomness.permute` with the key `fold(*parts, epoch)`.
        key: fold(*parts).
        device: where the result is to lie.
    """
    out = torch.empty(count, dtype=torch.int64, device=device)
    if count:
        rows, columns = grid_of(size)
        _in_order[(triton.cdiv(count, BLOCK),)](out, first, count, size, key, rows, columns, FEISTEL_ROUNDS, BLOCK)
    return out


def trial(device: str = "cuda") -> None:
    """Run every kernel once on next to nothing; it raises whatever its compiler or driver raises."""
    one = torch.ones(1, dtype=torch.int64, device=device)
    number, order = uniform(one, one, 1, 1), in_order(3, 3, 3, 1, device)
    if not 0.0 <= float(number) < 1.0 or sorted(order.tolist()) != [0, 1, 2]:
        raise RuntimeError("a trial of its kernels gave wrong numbers")


@triton.jit
@no_type_check
def _mix(word):
    word = word ^ (word >> 16)
    word = (word * 0x7FEB352D).to(tl.uint32)
    word = word ^ (word >> 15)
    word = (word * 0x5BD1E995).to(tl.uint32)
    word = word ^ (word >> 16)
    word = (word * 0x6C50B47D).to(tl.uint32)
    return word ^ (word >> 15)


@triton.jit
@no_type_check
def _uniform(keys, slots, out, purpose, total, count, block: tl.constexpr):
    index = (tl.program_id(0) * block + tl.arange(0, block)).to(tl.int64)
    valid = index < total
    ray = index // count
    number = (index - ray * count).to(tl.uint32)
    key = tl.load(keys + ray, mask=valid, other=0) ^ purpose
    slot = tl.load(slots + ray, mask=valid, other=0)
    word = _mix(_mix(key.to(tl.uint32)) ^ _mix(slot.to(tl.uint32)))
    word = _mix((word + number * 0x3C6EF35F).to(tl.uint32))
    tl.store(out + index, (word >> 8).to(tl.float32) * (1.0 / 16777216.0), mask=valid)


@triton.jit(do_not_specialize=["first", "key"])
@no_type_check
def _in_order(out, first, count, size, key, rows, columns, rounds: tl.constexpr, block: tl.constexpr):
    """As `randomness.permute`."""
    index = (tl.program_id(0) * block + tl.arange(0, block)).to(tl.int64)
    valid, place = index < count, index + first
    epoch = place // size
    position = place - epoch * size
    start = _mix((key + 0 * epoch).to(tl.uint32) ^ _mix(epoch.to(tl.uint32)) ^ 0x5A5A5A5A)
    walks = valid
    while tl.max(walks.to(tl.int32), axis=0) > 0:
        row = position // columns
        column = position - row * columns
        for number in tl.static_range(rounds):
            word = _mix((start + number * 0x1B873593).to(tl.uint32))
            if number % 2:
                column = (column + _mix(word ^ row.to(tl.uint32)).to(tl.int64)) % columns
            else:
                row = (row + _mix(word ^ column.to(tl.uint32)).to(tl.int64)) % rows
        position = tl.where(walks, row * columns + column, position)
        walks = walks & (position >= size)
    tl.store(out + index, position, mask=valid)

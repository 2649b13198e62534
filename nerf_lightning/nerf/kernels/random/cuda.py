"""Random numbers for CUDA, bit-identical to `nerf.randomness`; `TRITON_INTERPRET=1` runs them without a GPU."""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

BLOCK = 512


def uniform(
    keys: Int[Tensor, "*rays"], slots: Int[Tensor, "*rays"], purpose: int, count: int
) -> Float[Tensor, "*rays {count}"] | None:
    """Return `count` numbers per ray, uniform on [0, 1); None if rays are not contiguous."""
    if slots.dim() != 1:
        return None
    out = torch.empty(len(slots), count, device=slots.device)
    if out.numel():
        grid = (triton.cdiv(out.numel(), BLOCK),)
        _uniform[grid](keys.contiguous(), slots.contiguous(), out, purpose, out.numel(), count, BLOCK)
    return out


def trial(device: str = "cuda") -> None:
    """Run every kernel once on tiny input; it raises whatever the compiler or driver raises."""
    one = torch.ones(1, dtype=torch.int64, device=device)
    found = uniform(one, one, 1, 1)
    if found is None or not 0.0 <= float(found) < 1.0:
        raise RuntimeError("a trial of its kernels gave wrong numbers")


@triton.jit
@no_type_check
def mix(word):
    """Scramble 32 bits, as `randomness.mix`."""
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
    word = mix(mix(key.to(tl.uint32)) ^ mix(slot.to(tl.uint32)))
    word = mix((word + number * 0x3C6EF35F).to(tl.uint32))
    tl.store(out + index, (word >> 8).to(tl.float32) * (1.0 / 16777216.0), mask=valid)

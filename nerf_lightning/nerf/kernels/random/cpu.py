"""Random numbers and permutations for the CPU, bit-identical to `nerf.randomness`."""

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import njit
from torch import Tensor

from nerf_lightning.nerf.kernels.threads import over_rows
from nerf_lightning.nerf.randomness import grid_of, round_words


def uniform(
    keys: Int[Tensor, "*rays"], slots: Int[Tensor, "*rays"], purpose: int, count: int
) -> Float[Tensor, "*rays {count}"] | None:
    """Return `count` numbers per ray, uniform on [0, 1); None if rays are not contiguous."""
    if slots.dim() != 1:
        return None
    out = torch.empty(len(slots), count)
    over_rows(_uniform, len(slots), keys.numpy(), slots.numpy(), np.uint32(purpose), out.numpy())
    return out


def permute(index: Int[Tensor, "*n"], size: int, key: Int[Tensor, "*#n"]) -> Int[Tensor, "*n"] | None:
    """Return where a permutation of range(size) maps each index; None unless they are contiguous, with one key."""
    if key.numel() != 1 or index.dim() != 1:
        return None
    out, words = torch.empty_like(index), np.array(round_words(int(key)))
    _permute(0, len(index), index.contiguous().numpy(), *grid_of(size), size, words, out.numpy())
    return out


def trial() -> None:
    """Run every kernel once on tiny input; it raises whatever the compiler raises."""
    one = torch.ones(1, dtype=torch.int64)
    uniform(one, one, 1, 1)
    permute(one, 2, one)


@njit
@no_type_check
def mix(word):
    """Return a hash of a word of 32 bits (`randomness.mix`)."""
    word = np.uint32(word)
    word ^= word >> np.uint32(16)
    word = np.uint32(word * np.uint32(0x7FEB352D))
    word ^= word >> np.uint32(15)
    word = np.uint32(word * np.uint32(0x5BD1E995))
    word ^= word >> np.uint32(16)
    word = np.uint32(word * np.uint32(0x6C50B47D))
    return np.uint32(word ^ (word >> np.uint32(15)))


@njit(nogil=True, cache=True)
@no_type_check
def _uniform(first, last, keys, slots, purpose, out):
    for r in range(first, last):
        ray = mix(np.uint32(mix(np.uint32(keys[r]) ^ purpose) ^ mix(np.uint32(slots[r]))))
        for k in range(out.shape[1]):
            word = mix(np.uint32(ray + np.uint32(k) * np.uint32(0x3C6EF35F)))
            out[r, k] = np.float32(word >> np.uint32(8)) * np.float32(2.0**-24)


@njit(nogil=True, cache=True)
@no_type_check
def _permute(first, last, index, rows, columns, size, words, out):
    for i in range(first, last):
        position = index[i]
        while True:
            row, column = position // columns, position % columns
            for number in range(words.shape[0]):
                word = np.int64(words[number])
                if number % 2:
                    column = (column + np.int64(mix(np.uint32(word ^ row)))) % columns
                else:
                    row = (row + np.int64(mix(np.uint32(word ^ column)))) % rows
            position = row * columns + column
            if position < size:
                break
        out[i] = position

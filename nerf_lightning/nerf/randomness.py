"""Stateless randomness: every number is a hash of its purpose, so nothing depends on what was drawn before.

A uniform number is a function of (seed, attempt, step, purpose, ray slot in the global batch, sample number). Tiles,
ranks and devices slice the same numbers, and a resumed run draws what an uninterrupted one would have drawn.
Words are non-negative 32-bit integers kept in int64, and each multiplier is below 2^31, so no product overflows
and every device agrees.
`kernels/random/cpu.py` and `cuda.py` compute the same, `kernels/pixels/` the same permutation.
"""

import zlib
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import with_kernel
from nerf_lightning.nerf.types.tensor_struct import TensorStruct

Word = TypeVar("Word", int, Tensor)

WORD = 0xFFFFFFFF
FEISTEL_ROUNDS = 6


def mix(word: Word) -> Word:
    """Scramble 32-bit words: a bijection in which each input bit changes half of the output bits.

    >>> mix(torch.tensor([0, 1, 2])).unique().numel()
    3
    """
    word = word ^ (word >> 16)
    word = (word * 0x7FEB352D) & WORD
    word = word ^ (word >> 15)
    word = (word * 0x5BD1E995) & WORD
    word = word ^ (word >> 16)
    word = (word * 0x6C50B47D) & WORD
    return word ^ (word >> 15)


def purpose_word(purpose: str) -> int:
    """Return the 32-bit word that stands for a purpose, the same in every process."""
    return zlib.crc32(purpose.encode())


def fold(*parts: int | str) -> int:
    """Return one 32-bit key for a list of numbers and purposes; the order matters, and 0 is a number like any other.

    >>> fold(0, "rays") != fold(1, "rays")
    True
    """
    key = 0x243F6A88
    for part in parts:
        word = purpose_word(part) if isinstance(part, str) else part & WORD
        key = mix(key ^ mix(word) ^ 0x5A5A5A5A)
    return key


@dataclass(frozen=True)
class RayRandom(TensorStruct):
    """The random numbers of a batch of rays in one training step; slice it like the rays."""

    key: Int[Tensor, "*rays"]
    """fold(seed, attempt, step), the same for all rays."""
    slots: Int[Tensor, "*rays"]
    """The ray's index in the global batch."""

    def uniform(self, purpose: str, count: int) -> Float[Tensor, "*rays {count}"]:
        """Return `count` numbers per ray, uniform on [0, 1), in steps of 2^-24."""
        return uniform(self.key, self.slots, purpose_word(purpose), count)

    def normal(self, purpose: str, count: int) -> Float[Tensor, "*rays {count}"]:
        """Return `count` standard normal numbers per ray."""
        return self.along(count).normal(purpose)

    def along(self, count: int) -> "PointRandom":
        """Return the numbers of the first `count` samples of each ray."""
        number = torch.arange(count, device=self.slots.device).expand(*self.slots.shape, count)
        return PointRandom(self.key[..., None], self.slots[..., None], number)


@dataclass(frozen=True)
class PointRandom(TensorStruct):
    """The random numbers of points on rays: functions of the ray's slot and of the sample's number on it."""

    key: Int[Tensor, "*#points"]
    """fold(seed, attempt, step)."""
    slots: Int[Tensor, "*#points"]
    """The ray's index in the global batch."""
    number: Int[Tensor, "*points"]
    """Index of the sample on its ray."""

    def uniform(self, purpose: str) -> Float[Tensor, "*points"]:
        """Return a number for each point, uniform on [0, 1), in steps of 2^-24."""
        return _hashed(self.key, self.slots, self.number, purpose_word(purpose))

    def normal(self, purpose: str) -> Float[Tensor, "*points"]:
        """Return a standard normal number for each point (Box and Muller, 1958)."""
        radius = torch.sqrt(-2.0 * torch.log1p(-self.uniform(purpose)))
        return radius * torch.cos(2.0 * torch.pi * self.uniform(purpose + ".angle"))


def _hashed(key: Tensor, slots: Tensor, number: Tensor, word: int) -> Tensor:
    ray = mix(key ^ word) ^ mix(slots & WORD)
    words = mix((mix(ray) + number * 0x3C6EF35F) & WORD)
    return (words >> 8).to(torch.float32) * 2.0**-24


@with_kernel("random.cpu", "random.cuda")
def uniform(
    key: Int[Tensor, "*rays"], slots: Int[Tensor, "*rays"], word: int, count: int
) -> Float[Tensor, "*rays {count}"]:
    """Return `count` numbers per ray, uniform on [0, 1), given the word of a purpose."""
    number = torch.arange(count, device=slots.device).expand(*slots.shape, count)
    return _hashed(key[..., None], slots[..., None], number, word)


def batch_random(
    key: int | Int[Tensor, ""], num_rays: int, device: torch.device | str = "cpu", first: int = 0
) -> RayRandom:
    """Return the random numbers of a batch, or of its rays from slot `first` on; `key` comes from `fold`."""
    slots = torch.arange(first, first + num_rays, device=device)
    return RayRandom(key=key.expand_as(slots) if isinstance(key, Tensor) else torch.full_like(slots, key), slots=slots)


@with_kernel("random.cpu")
def permute(index: Int[Tensor, "*n"], size: int, key: Int[Tensor, "*#n"]) -> Int[Tensor, "*n"]:
    """Return where a keyed permutation of range(size) maps each index; nothing is stored, and any size is allowed.

    An alternating Feistel network on a grid of about sqrt(size) x sqrt(size) cells: each round adds a keyed hash of
    one coordinate to the other. The few cells beyond `size` are mapped again until the path returns (cycle walking;
    Black and Rogaway, 2002), so the result is exactly a permutation.

    >>> torch.equal(permute(torch.arange(10), 10, torch.full((10,), 7)).sort().values, torch.arange(10))
    True
    """
    rows, columns = grid_of(size)
    position = _feistel(index, rows, columns, key)
    while (outside := (position >= size).nonzero(as_tuple=True))[0].numel():
        position[outside] = _feistel(position[outside], rows, columns, key.expand(position.shape)[outside])
    return position


def grid_of(size: int) -> tuple[int, int]:
    """Return rows and columns of the cells that a permutation of range(size) walks through."""
    rows = max(1, int(size**0.5))
    return rows, -(-size // rows)


def _feistel(index: Tensor, rows: int, columns: int, key: Tensor) -> Tensor:
    row = index // columns
    column = index - row * columns
    for number, round_key in enumerate(round_words(key)):
        if number % 2:
            column = (column + mix(round_key ^ row)) % columns
        else:
            row = (row + mix(round_key ^ column)) % rows
    return row * columns + column


def round_words(key: Word) -> list[Word]:
    """Return a word for each round of a permutation."""
    # As many words as there are keys: a batch within one epoch has one.
    return [mix((key + number * 0x1B873593) & WORD) for number in range(FEISTEL_ROUNDS)]

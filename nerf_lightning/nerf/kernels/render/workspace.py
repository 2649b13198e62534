"""Memory for the backward pass of whole rays; steps reuse it, since new memory is slow."""

import os
import threading
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

NUMBERS = 8
"""Columns per sample (`render.compositing`)."""
MOST_BYTES = 1 << 28
"""Maximum size of unused workspaces."""


@dataclass
class Workspace:
    """What the forward pass keeps of some samples."""

    owners: Tensor
    """Index of each sample's ray; negative: none. For rays with equal numbers of samples, the sample's index among
    those of all rays."""
    numbers: Tensor
    points: Tensor
    """Positions in the unit cube."""
    density_words: Tensor
    """Inputs of all layers of the density MLP."""
    color_words: Tensor

    @classmethod
    def of(cls, rows: int, density_words: int, color_words: int) -> "Workspace":
        """Return a workspace for `rows` samples, with the given numbers of words per sample."""
        return cls(
            torch.empty(rows, dtype=torch.int32),
            torch.empty(rows, NUMBERS),
            torch.empty(rows, 3),
            torch.empty(rows, density_words, dtype=torch.int32),
            torch.empty(rows, color_words, dtype=torch.int32),
        )

    @property
    def size(self) -> tuple[int, int]:
        """Words per sample: workspaces of equal size are interchangeable."""
        return self.density_words.shape[1], self.color_words.shape[1]

    @property
    def rows(self) -> int:
        """Number of samples there is room for."""
        return self.owners.shape[0]

    @property
    def bytes(self) -> int:
        """Memory it takes."""
        return sum(each.numel() * each.element_size() for each in self._tensors())

    def arrays(self) -> tuple[np.ndarray, ...]:
        """Return the arguments of the kernels."""
        return tuple(each.numpy() for each in self._tensors())

    def _tensors(self) -> tuple[Tensor, ...]:
        return self.owners, self.numbers, self.points, self.density_words, self.color_words


_spare: list[Workspace] = []
_lock = threading.Lock()


def take_workspace(rows: int, size: tuple[int, int]) -> Workspace:
    """Return an unused workspace for at least `rows` samples."""
    with _lock:
        for number, spare in enumerate(_spare):
            if spare.size == size and spare.rows >= rows:
                return _spare.pop(number)
    return Workspace.of(rows, *size)


def give_back(workspaces: list[Workspace]) -> None:
    """Release workspaces for reuse; if too much memory is unused, the oldest are freed."""
    with _lock:
        _spare.extend(workspaces)
        while sum(each.bytes for each in _spare) > MOST_BYTES:
            _spare.pop(0)


def forget_workspaces() -> None:
    """Free all unused workspaces: memory has run out."""
    with _lock:
        _spare.clear()


def _renew_lock() -> None:
    global _lock
    _lock = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew_lock)  # another thread of the parent may have held it

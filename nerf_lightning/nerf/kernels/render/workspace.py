"""Memory for what the backward pass of whole rays needs; steps take it from one another, since fresh memory is slow."""

import os
import threading
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

NUMBERS = 8
"""Of each sample (`render.quadrature`)."""
MOST_BYTES = 1 << 28
"""Of what waits for a step to take it."""


@dataclass
class Workspace:
    """What the forward pass leaves behind of some samples."""

    owners: Tensor
    """Number of each sample's ray; negative: none. Of rays with equally many samples the number of the sample among
    those of all rays."""
    numbers: Tensor
    points: Tensor
    """In the unit cube."""
    density_words: Tensor
    """Inputs of all layers of the density's perceptron."""
    color_words: Tensor

    @classmethod
    def of(cls, rows: int, density_words: int, color_words: int) -> "Workspace":
        """Return one for so many samples, with so many words for each."""
        return cls(
            torch.empty(rows, dtype=torch.int32),
            torch.empty(rows, NUMBERS),
            torch.empty(rows, 3),
            torch.empty(rows, density_words, dtype=torch.int32),
            torch.empty(rows, color_words, dtype=torch.int32),
        )

    @property
    def size(self) -> tuple[int, int]:
        """Words per sample: those of one size may take each other's place."""
        return self.density_words.shape[1], self.color_words.shape[1]

    @property
    def rows(self) -> int:
        """How many samples there is room for."""
        return self.owners.shape[0]

    @property
    def bytes(self) -> int:
        """How much memory it takes."""
        return sum(each.numel() * each.element_size() for each in self._tensors())

    def arrays(self) -> tuple[np.ndarray, ...]:
        """Return what the kernels take."""
        return tuple(each.numpy() for each in self._tensors())

    def _tensors(self) -> tuple[Tensor, ...]:
        return self.owners, self.numbers, self.points, self.density_words, self.color_words


_spare: list[Workspace] = []
_lock = threading.Lock()


def take_workspace(rows: int, size: tuple[int, int]) -> Workspace:
    """Return a workspace that nobody uses, for at least so many samples."""
    with _lock:
        for number, spare in enumerate(_spare):
            if spare.size == size and spare.rows >= rows:
                return _spare.pop(number)
    return Workspace.of(rows, *size)


def give_back(workspaces: list[Workspace]) -> None:
    """Let others use them; those that have waited longest are let go where there are too many."""
    with _lock:
        _spare.extend(workspaces)
        while sum(each.bytes for each in _spare) > MOST_BYTES:
            _spare.pop(0)


def forget_workspaces() -> None:
    """Let go of all that nobody uses: there is no memory left."""
    with _lock:
        _spare.clear()


def _renew_lock() -> None:
    global _lock
    _lock = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew_lock)  # another thread of the parent may have held it

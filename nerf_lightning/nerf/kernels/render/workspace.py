"""Memory for what the backward pass of whole rays needs; steps take it from one another, since fresh memory is slow."""

import threading
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nerf_lightning.nerf.kernels.mlp.cpu import ROWS

NUMBERS = 8
"""Of each sample (`render.quadrature`)."""


@dataclass
class Workspace:
    """What the forward pass leaves behind of some blocks of ROWS samples."""

    owners: Tensor
    """Number of each sample's ray; negative: none."""
    numbers: Tensor
    points: Tensor
    """In the unit cube."""
    density_words: Tensor
    """Inputs of all layers of the density's perceptron."""
    color_words: Tensor

    @classmethod
    def of(cls, blocks: int, density_words: int, color_words: int) -> "Workspace":
        """Return one for so many blocks, with so many words per sample."""
        rows = blocks * ROWS
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
    def blocks(self) -> int:
        """How many there is room for."""
        return self.owners.shape[0] // ROWS

    def arrays(self) -> tuple[np.ndarray, ...]:
        """Return what the kernels take."""
        tensors = self.owners, self.numbers, self.points, self.density_words, self.color_words
        return tuple(each.numpy() for each in tensors)


MOST_SPARE = 32

_spare: list[Workspace] = []
_spare_lock = threading.Lock()


def take_workspace(blocks: int, size: tuple[int, int]) -> Workspace:
    """Return a workspace that nobody uses, for at least so many blocks."""
    with _spare_lock:
        for number, spare in enumerate(_spare):
            if spare.size == size and spare.blocks >= blocks:
                return _spare.pop(number)
        # Of another field, or too small: what is no longer asked for must not stay.
        _spare[:] = [spare for spare in _spare if spare.size != size][-MOST_SPARE:]
    return Workspace.of(blocks, *size)


def give_back(workspaces: list[Workspace]) -> None:
    """Let others use them."""
    with _spare_lock:
        _spare.extend(workspaces)

"""Where a self-test is done: the device, its precisions, and what lies above this room and is handed in."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.products import Products
from nerf_lightning.selftest.runs import Runs


@dataclass(frozen=True)
class Place:
    """What the checks are made for."""

    device: torch.device
    products: tuple[Products, ...]
    """What the device can multiply in; the first is float32."""
    chosen: Products
    """What the user's `trainer` multiplies in."""
    compiles: bool
    """Whether torch.compile is tried: on a GPU, or where the user asks for it."""
    runs: Runs
    """The command line at work on a small capture."""
    read_model: Callable[[Path], Model]
    """Returns the model of a checkpoint, on the CPU."""

    @property
    def is_cuda(self) -> bool:
        """Whether the device is a GPU of CUDA."""
        return self.device.type == "cuda"

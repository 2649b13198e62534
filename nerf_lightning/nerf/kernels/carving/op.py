"""Carving by one view: by kernels for pinholes, else in plain torch."""

from types import ModuleType

import torch
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import cpu_backend
from nerf_lightning.nerf.kernels.carving import reference
from nerf_lightning.nerf.types.scene import Cameras


def steps_for(cameras: Cameras, centers: Tensor) -> ModuleType:
    """Return the module with `add_seen` and `carve` for these cameras and cells."""
    plain = cameras.lens_model == "pinhole" and centers.dtype == cameras.c2w.dtype == torch.float32
    kernels = cpu_backend("carving.cpu", centers.device) if plain else None
    return reference if kernels is None else kernels

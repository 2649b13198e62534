"""Spherical harmonics by a kernel; None where there is none for what is given."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import cuda_backend


def spherical_harmonics(points: Float[Tensor, "*points 3"], degree: int) -> Float[Tensor, "*points features"] | None:
    """Do what `encoders.spherical_harmonics` does, without gradients, for float32 directions."""
    plain = points.dtype == torch.float32 and not points.requires_grad
    kernels = cuda_backend("spherical_harmonics.cuda", points.device) if plain else None
    if kernels is None:
        return None
    return kernels.spherical_harmonics(points.reshape(-1, 3), degree).view(*points.shape[:-1], -1)

"""Distorted points undone by a kernel; None where there is none for what is given."""

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import cpu_backend


def undistort(
    plane: Float[Tensor, "*points 2"], lens: Float[Tensor, "*#points 6"], newton_steps: int
) -> Float[Tensor, "*points 2"] | None:
    """Do what `geometry.lenses` does for the radial and tangential model, without gradients."""
    kernels = cpu_backend("lenses.cpu", plane.device)
    if kernels is None or plane.requires_grad or lens.requires_grad:
        return None
    rows = plane.reshape(-1, 2), lens.expand(*plane.shape[:-1], 6).reshape(-1, 6)
    return kernels.undistort(*rows, newton_steps).view(plane.shape)

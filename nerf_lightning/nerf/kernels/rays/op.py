"""Rays of pixels by a kernel; None where there is none for what is given."""

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import cuda_backend
from nerf_lightning.nerf.types.rays import PixelIndex, RayBundle
from nerf_lightning.nerf.types.scene import Cameras


def rays_through_pixels(
    cameras: Cameras,
    pixels: PixelIndex,
    near: Float[Tensor, "views"],
    far: Float[Tensor, "views"],
    subpixel_offset: Float[Tensor, "*#rays 2"] | None = None,
    per_side: int = 1,
) -> RayBundle | None:
    """Do what `geometry.cameras.rays_through_pixels` does, for rays through the middles of pixels."""
    kernels = cuda_backend("rays.cuda", cameras.c2w.device) if subpixel_offset is None else None
    if kernels is None or not kernels.takes(cameras):
        return None
    return kernels.rays_through_pixels(cameras, pixels, near, far, per_side)

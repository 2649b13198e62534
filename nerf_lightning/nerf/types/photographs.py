"""What a model may see that renders a scene from its photographs."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.nerf.types.scene import Background, Cameras, PixelStore
from nerf_lightning.nerf.types.tensor_struct import TensorStruct


@dataclass(frozen=True)
class Photographs(TensorStruct):
    """Photographs of one or several captures, with where they were taken; `.to(device)` leaves the pixels in place."""

    cameras: Cameras
    """One per photograph, through the world (`Cameras.ndc` is None)."""
    pixels: PixelStore
    """Theirs alone, in the same order; the flat array may hold others."""
    numbers: Int[Tensor, "views"]
    """What number each has in the scene: what `RayBundle.photograph` says."""
    capture: Int[Tensor, "views"]
    """Number of the capture that each belongs to: what `RayBundle.capture` says."""
    background: Background
    """What lies behind transparent pixels."""
    middle: Float[Tensor, "captures 3"]
    """What the cameras of each capture look at, scene units."""
    around: Bool[Tensor, "captures"]
    """Whether a capture's cameras stand around its content; else they face forward, or look everywhere."""

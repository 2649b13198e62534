"""The data of a model that renders a scene from its photographs."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.nerf.types.scene import Background, Cameras, PixelStore
from nerf_lightning.nerf.types.tensor_struct import TensorStruct


@dataclass(frozen=True)
class Photographs(TensorStruct):
    """Photographs of one or several captures, with where they were taken; `.to(device)` leaves the pixels in place."""

    cameras: Cameras
    """One per photograph, in world coordinates (`Cameras.ndc` is None)."""
    pixels: PixelStore
    """Pixels of these photographs, in the same order; the flat array may hold others."""
    numbers: Int[Tensor, "views"]
    """Each photograph's number in the scene, as in `RayBundle.photograph`."""
    capture: Int[Tensor, "views"]
    """The number of each photograph's capture, as in `RayBundle.capture`."""
    background: Background
    """What is behind transparent pixels."""
    middle: Float[Tensor, "captures 3"]
    """What the cameras of each capture look at, scene units."""
    around: Bool[Tensor, "captures"]
    """Whether a capture's cameras surround its content; else they face forward, or look everywhere."""

"""The input of a field."""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.nerf.randomness import PointRandom
from nerf_lightning.nerf.types.tensor_struct import TensorStruct


@dataclass(frozen=True)
class Points(TensorStruct):
    """Points in space, with the directions and photographs from which they are seen.

    What all samples of a ray share (its direction, its photograph) is stored once, with an axis of length 1.
    """

    positions: Float[Tensor, "*points 3"]
    """Positions in scene units."""
    directions: Float[Tensor, "*#points 3"] | None = None
    """Unit length, from the camera to the point; None if only density is needed."""
    photograph: Int[Tensor, "*#points"] | None = None
    """Number of the view whose photograph is explained; None outside training steps (`RayBundle.photograph`)."""
    random: PointRandom | None = None
    """The step's random numbers; None outside training steps."""
    covariance: Float[Tensor, "*points 6"] | None = None
    """Covariance of the part of its pixel's cone that a sample represents (`geometry.cones`), scene units squared; None
    if unused (`Field.sees_cones`), or if a point belongs to no pixel."""

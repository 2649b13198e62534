"""What a field is asked about."""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.nerf.randomness import PointRandom
from nerf_lightning.nerf.types.tensor_struct import TensorStruct


@dataclass(frozen=True)
class Points(TensorStruct):
    """Points in space, from where they are seen, and for whom.

    What all samples of a ray share (its direction, its photograph) stands there once, with an axis of length 1.
    """

    positions: Float[Tensor, "*points 3"]
    """Scene units."""
    directions: Float[Tensor, "*#points 3"] | None = None
    """Unit length, from the camera to the point; None where density alone is asked for."""
    photograph: Int[Tensor, "*#points"] | None = None
    """Number of the view whose photograph is explained; None outside of training steps (`RayBundle.photograph`)."""
    random: PointRandom | None = None
    """The step's random numbers; None outside of training steps."""
    covariance: Float[Tensor, "*points 6"] | None = None
    """Of what a sample stands for of its pixel's cone (`geometry.cones`), scene units squared; None where nobody asks
    (`Field.sees_cones`), and where a point is no pixel's."""

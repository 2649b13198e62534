"""What the sources of rays show at their points."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.nerf.types.tensor_struct import TensorStruct


@dataclass(frozen=True)
class Views(TensorStruct):
    """What the sources show at the points of rays."""

    states: Float[Tensor, "rays samples sources width"]
    """Colour and features together."""
    colors: Float[Tensor, "rays samples sources 3"]
    """In [0, 1]."""
    turned: Float[Tensor, "rays samples sources 4"]
    """How the ray looks on the point against how the source does (`projection.Projected`)."""
    visible: Bool[Tensor, "rays samples sources"]

"""What of a field the kernels that render whole rays compute with."""

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.kernels.hash_grid.layout import HashGridLayout


@dataclass(frozen=True)
class FieldParts:
    """A hash grid over a box, and two perceptrons without biases: density, and colour by what that hands on."""

    aabb: Float[Tensor, "2 3"]
    """The box, outside of which there is nothing."""
    table: Float[Tensor, "entries features"]
    layout: HashGridLayout
    bias: float
    """Added to the raw density, before the exponential."""
    density_weights: list[Tensor]
    color_weights: list[Tensor]
    """Of the colour's; its inputs are the density's outputs and the features of the direction."""
    encode_directions: Callable[[Float[Tensor, "rays 3"]], Float[Tensor, "rays features"]]
    least_slope: float = 0.0
    """Of a colour over its raw value on the way back from black or full, in training."""

    @property
    def weights(self) -> tuple[list[Tensor], list[Tensor]]:
        """Of both perceptrons."""
        return self.density_weights, self.color_weights

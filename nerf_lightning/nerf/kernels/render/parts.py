"""What of a field the kernels that render whole rays compute with."""

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.kernels.hash_grid.layout import HashGridLayout
from nerf_lightning.nerf.types.rays import RayBundle


@dataclass(frozen=True)
class FieldParts:
    """A hash grid, and two perceptrons without biases: density, and color by what that hands on."""

    aabb: Float[Tensor, "2 3"]
    """The box, outside of which there is nothing. Where space is contracted, the box whose inside stays as it is."""
    table: Float[Tensor, "entries features"]
    layout: HashGridLayout
    bias: float
    """Added to the raw density, before the exponential."""
    density_weights: list[Tensor]
    color_weights: list[Tensor]
    """Of the color's; its inputs are the density's outputs and what a ray's samples share. Empty: density only."""
    ray_features: Callable[[RayBundle], Float[Tensor, "rays features"]]
    """Return what all samples of a ray share: the features of its direction, and a photograph's code."""
    least_slope: float = 0.0
    """Of a color over its raw value on the way back from black or full, in training."""
    contracted: bool = False
    """Whether all space, contracted around the box, is mapped to the unit cube (`geometry.contraction`)."""
    ray_features_learn: bool = False
    """Whether there is anything to learn in `ray_features`."""

    def handed_over(self, shared: int) -> int:
        """Return how many outputs of the density are inputs of the colors, of which `shared` belong to the ray."""
        return self.color_weights[0].shape[1] - shared if self.color_weights else 0

    @property
    def weights(self) -> tuple[list[Tensor], list[Tensor]]:
        """Of both perceptrons."""
        return self.density_weights, self.color_weights

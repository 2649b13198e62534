"""The contract of a field: density and color of points in space."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.kernels.render.op import FieldParts
from nerf_lightning.nerf.matmul_precision import MatmulPrecision
from nerf_lightning.nerf.part import Part
from nerf_lightning.nerf.types.points import Points
from nerf_lightning.nerf.types.renderings import FieldOutput


@dataclass(frozen=True)
class HiddenLayer:
    """Neurons that a field could do without, by the names that its state has for what makes and what reads them."""

    rows: tuple[str, ...]
    """What has an entry for each neuron along its first axis; the matrix that makes them comes first, and
    then its bias, if it has one."""
    columns: tuple[str, ...]
    """Matrices whose first columns read them, one each; columns that read something else follow."""


class Field(Part, ABC):
    """A radiance field: it answers what is asked of points (`types.points`)."""

    sees_cones: bool = False
    """True where the result depends on the pixels' cones (`Points.covariance`)."""

    compiles: bool = True
    """False where kernels of our own do most of the work, which torch.compile cannot see into."""

    matmul_precision: MatmulPrecision = "float32"
    """The precision of the products with the field's weights, and of nothing else: layers are
    `matmul_precision.Linear`, and kernels are given this. A field that does neither multiplies in float32 everywhere,
    which is slow and right."""

    @abstractmethod
    def density(self, points: Points) -> tuple[Float[Tensor, "*points"], Float[Tensor, "*points features"] | None]:
        """Return the density per unit length, without paying for color.

        Returns:
            The density; and features that spare `forward` what was computed here, None where it has no use for them.
        """

    @abstractmethod
    def forward(self, points: Points, features: Float[Tensor, "*points features"] | None = None) -> FieldOutput:
        """Return density and color.

        Args:
            points: with directions.
            features: what `density` returned for the same points, with or without gradients; None: nothing was asked
                before. What comes out is the same, and its gradients too.
        """

    def hidden_layers(self) -> list[HiddenLayer]:
        """Return the layers that a narrower field of this kind, with another `width`, would have fewer neurons in."""
        return []

    def hidden_activations(self, points: Points) -> list[Float[Tensor, "*points neurons"]]:
        """Return what the neurons of `hidden_layers` come to at points with directions, layer by layer."""
        return []

    def parts(self) -> FieldParts | None:
        """Return what kernels need that render whole rays by themselves; None where the field is of another kind."""
        return None

    @abstractmethod
    def reset_parameters(self) -> None:
        """Draw every parameter anew from torch's generator."""

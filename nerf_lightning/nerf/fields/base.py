"""The contract of a field: density and color of points in space."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.kernels.render.op import FieldParts
from nerf_lightning.nerf.matmul_precision import MatmulPrecision
from nerf_lightning.nerf.part import Part
from nerf_lightning.nerf.types.rays import Points
from nerf_lightning.nerf.types.renderings import FieldOutput


@dataclass(frozen=True)
class HiddenLayer:
    """Neurons that could be pruned, given by the state names of the tensors that produce and read them."""

    rows: tuple[str, ...]
    """Tensors with an entry for each neuron along the first axis: first the matrix that produces them, then its bias,
    if it has one."""
    columns: tuple[str, ...]
    """Matrices whose first columns read the neurons, one column each; columns that read something else follow."""


class Field(Part, ABC):
    """A radiance field: density and color at points (`types.rays`)."""

    sees_cones: bool = False
    """True if the result depends on the pixels' cones (`Points.covariance`)."""

    compiles: bool = True
    """False if this program's own kernels, which are opaque to torch.compile, do most of the work."""

    matmul_precision: MatmulPrecision = "float32"
    """The precision of the products with the field's weights, and of nothing else: layers are
    `matmul_precision.Linear`, and kernels receive this. A field that does neither multiplies in float32 everywhere,
    which is slow and correct."""

    @abstractmethod
    def density(self, points: Points) -> tuple[Float[Tensor, "*points"], Float[Tensor, "*points features"] | None]:
        """Return the density per unit length, without computing color.

        Returns:
            The density, and features that `forward` can reuse, None if it cannot use any.
        """

    @abstractmethod
    def forward(self, points: Points, features: Float[Tensor, "*points features"] | None = None) -> FieldOutput:
        """Return density and color.

        Args:
            points: with directions.
            features: what `density` returned for the same points, with or without gradients; None: not computed yet.
                The result and its gradients are the same either way.
        """

    def hidden_layers(self) -> list[HiddenLayer]:
        """Return the layers that have fewer neurons in a field of this kind with a smaller `width`."""
        return []

    def hidden_activations(self, points: Points) -> list[Float[Tensor, "*points neurons"]]:
        """Return the activations of `hidden_layers` at points with directions, layer by layer."""
        return []

    def parts(self) -> FieldParts | None:
        """Return what whole-ray kernels need; None if they do not support the field."""
        return None

    @abstractmethod
    def reset_parameters(self) -> None:
        """Reinitialize every parameter from torch's generator."""

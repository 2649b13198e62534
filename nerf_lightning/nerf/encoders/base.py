"""The contract of an encoder: points in, features out, any leading shape."""

from abc import ABC, abstractmethod

from jaxtyping import Float
from torch import Tensor, nn

from nerf_lightning.nerf.kernels.hash_grid.layout import HashGridLayout
from nerf_lightning.nerf.matmul_precision import MatmulPrecision
from nerf_lightning.nerf.part import Part


class Encoder(Part, ABC):
    """Map coordinates to features that an MLP can resolve. `in_dim` is 3: positions or unit directions."""

    in_dim: int = 3
    needs_unit_cube: bool = False
    """True if points outside the unit cube are meaningless; the field must map its positions into it."""
    matmul_precision: MatmulPrecision = "float32"
    """The precision of the products with the encoder's matrices, if it has any; its field sets it."""

    @property
    @abstractmethod
    def out_dim(self) -> int:
        """Number of features."""

    @abstractmethod
    def forward(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points features"]:
        """Return the features, in the points' dtype."""

    def attach_gradients(
        self, points: Float[Tensor, "*points 3"], features: Float[Tensor, "*points features"]
    ) -> Float[Tensor, "*points features"]:
        """Return known features of points, computed before without gradients, with gradients attached."""
        return self(points)

    def tables(self) -> list[nn.Parameter]:
        """Return the encoder's parameters that are lookup tables, not matrices to multiply with.

        Their gradients are zero in most rows, and they do not decay.
        """
        return []

    def grid(self) -> tuple[Float[Tensor, "entries features"], HashGridLayout] | None:
        """Return the table and its layout if the features are exactly those of one hash grid; else None."""
        return None

    @abstractmethod
    def reset_parameters(self) -> None:
        """Reinitialize the parameters from torch's generator, if there are any."""


class ConeEncoder(Encoder):
    """An encoder that may use the cone of a point's pixel (`geometry.cones`), in the coordinates of the points."""

    sees_cones: bool
    """Whether it does; else it needs no cones."""

    @abstractmethod
    def forward(
        self, points: Float[Tensor, "*points 3"], covariance: Float[Tensor, "*points 6"] | None = None
    ) -> Float[Tensor, "*points features"]:
        """Return the features; without a covariance, those of the points themselves, as if it were 0."""

    @abstractmethod
    def attach_gradients(
        self,
        points: Float[Tensor, "*points 3"],
        features: Float[Tensor, "*points features"],
        covariance: Float[Tensor, "*points 6"] | None = None,
    ) -> Float[Tensor, "*points features"]:
        """Return known features of points, computed before without gradients, with gradients attached."""


def require_direction_encoder(encoder: Encoder) -> None:
    """Refuse an encoder that cannot encode directions.

    Raises:
        ValueError: it needs points in the unit cube.
    """
    if encoder.needs_unit_cube:
        raise ValueError(f"{type(encoder).__name__} cannot encode directions: directions do not lie in the unit cube")


def tables_of(model: nn.Module) -> list[nn.Parameter]:
    """Return the tables of the encoders within a model, each once."""
    encoders = [module for module in model.modules() if isinstance(module, Encoder)]
    return list({id(table): table for encoder in encoders for table in encoder.tables()}.values())


def matrices_of(model: nn.Module) -> list[nn.Parameter]:
    """Return the matrices that multiply features: a model's two-dimensional parameters, except tables."""
    tables = set(map(id, tables_of(model)))
    return [weight for weight in model.parameters() if weight.ndim == 2 and id(weight) not in tables]

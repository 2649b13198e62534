"""The contract of a field: density and colour of points in space."""

from abc import ABC, abstractmethod

from jaxtyping import Float
from torch import Tensor, nn

from nerf_lightning.nerf.products import Linear, Products
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.types.renderings import FieldOutput
from nerf_lightning.nerf.types.scene import Scene


class Field(nn.Module, ABC):
    """A radiance field. Positions are in scene units, directions have unit length."""

    needs_whole_batch: bool = False
    """True where the result for one ray depends on the others (batch normalisation); such a field is never tiled."""

    needs_random: bool = False
    """True where training draws random numbers for each sample."""

    compiles: bool = True
    """False where kernels of our own do most of the work, which torch.compile cannot see into."""

    products: Products = "float32"
    """The precision of the products with the field's weights, and of nothing else: layers are `products.Linear`, and
    kernels are given this. A field that does neither multiplies in float32 everywhere, which is slow and right."""

    def multiply_in(self, products: Products) -> None:
        """Set the precision of the products with the field's weights; positions, densities and colours stay float32."""
        for module in self.modules():
            if isinstance(module, Linear | Field):
                module.products = products

    def fit_to(self, scene: Scene) -> None:
        """Take note of where the scene's content lies, once, before training; a checkpoint carries it."""

    @abstractmethod
    def density(self, positions: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points"]:
        """Return the density per unit length, without paying for colour."""

    @abstractmethod
    def forward(
        self,
        positions: Float[Tensor, "*rays samples 3"],
        directions: Float[Tensor, "*rays 1 3"],
        random: RayRandom | None,
    ) -> FieldOutput:
        """Return density and colour along rays; `random` is None outside training."""

    def density_and_features(
        self, positions: Float[Tensor, "*points 3"]
    ) -> tuple[Float[Tensor, "*points"], Float[Tensor, "*points features"] | None]:
        """Return the density, and whatever `from_features` can use instead of computing it again; None for nothing."""
        return self.density(positions), None

    def from_features(
        self,
        positions: Float[Tensor, "*rays samples 3"],
        directions: Float[Tensor, "*rays 1 3"],
        random: RayRandom | None,
        features: Float[Tensor, "*rays samples features"],
    ) -> FieldOutput:
        """Return what `forward` returns, given the features of the same positions; gradients included."""
        return self(positions, directions, random)

    @abstractmethod
    def reset_parameters(self) -> None:
        """Draw every parameter anew from torch's generator."""

"""Two small MLPs behind an encoder of the unit cube (Sec. 5.4, arXiv 2201.05989)."""

from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerf_lightning.nerf.encoders.base import Encoder, require_direction_encoder
from nerf_lightning.nerf.fields.base import Field
from nerf_lightning.nerf.geometry.boxes import center_and_half, require_box, to_unit_cube
from nerf_lightning.nerf.geometry.contraction import Contracted, contract, in_unit_ball
from nerf_lightning.nerf.kernels.mlp.mlp import mlp
from nerf_lightning.nerf.ranges import require_ranges
from nerf_lightning.nerf.types.points import Points
from nerf_lightning.nerf.types.renderings import FieldOutput
from nerf_lightning.nerf.types.scene import Scene

LARGEST_EXPONENT = 15.0
THICK, THIN = 3.0, -1.0


class HashField(Field):
    """Density from one hidden layer, colour from two more that see the direction; exponential density.

    Positions are mapped from the scene's box, or from contracted space, to the unit cube. Outside of the box (without
    contraction) there is nothing.

    Args:
        position_encoder: features of points in the unit cube.
        direction_encoder: features of unit directions.
        width: width of every hidden layer.
        feature_dim: what the density's MLP hands to the colour's, the raw density included.
        density_bias: added to the raw density, before the exponential. None: thick (3) where the photographs have
            alpha, which tells at once where nothing is, and thin (-1) where they have none: there a dense start would
            remain as fog of the background's colour.
        contraction: map all space, contracted around the box, instead of the box alone; None: as the scene's space.
    """

    compiles = False

    aabb: Tensor
    bias: Tensor

    def __init__(
        self,
        position_encoder: Encoder,
        direction_encoder: Encoder,
        width: int = 64,
        feature_dim: int = 16,
        density_bias: float | None = None,
        contraction: bool | None = None,
    ):
        super().__init__()
        require_ranges(locals(), {"width": (1, 1 << 20), "feature_dim": (1, 1 << 20)})
        require_direction_encoder(direction_encoder)
        self.position_encoder = position_encoder
        self.direction_encoder = direction_encoder
        self.density_bias = density_bias
        self.contracted = Contracted(contraction)
        self.register_buffer("bias", torch.tensor(THIN if density_bias is None else float(density_bias)))
        self.register_buffer("aabb", torch.tensor([[-1.0] * 3, [1.0] * 3]))
        self.density_mlp = _weights(position_encoder.out_dim, width, feature_dim)
        self.color_mlp = _weights(feature_dim + direction_encoder.out_dim, width, width, 3)
        self.reset_parameters()

    def fit_to(self, scene: Scene) -> None:
        """Take note of the box that holds the scene's content, and whether the photographs have alpha."""
        self.aabb.copy_(scene.aabb)
        self.contracted.fit_to(scene)
        if self.density_bias is None:
            self.bias.fill_(THICK if scene.pixels.has_transparency else THIN)

    def require_sound_state(self) -> None:
        """Look at what was loaded.

        Raises:
            InputError: a box without inside.
        """
        require_box(self.aabb)

    def density(self, points: Points) -> tuple[Float[Tensor, "*points"], Float[Tensor, "*points features"]]:
        """Return the density per unit length, and the encoder's features."""
        encoded = self.position_encoder(self._unit(points.positions))
        return self._density(self._through(self.density_mlp, encoded), points.positions), encoded

    def forward(self, points: Points, features: Float[Tensor, "*points features"] | None = None) -> FieldOutput:
        """Return density and colour; density does not depend on the direction."""
        unit = self._unit(points.positions)
        encoder = self.position_encoder
        encoded = encoder(unit) if features is None else encoder.attach_gradients(unit, features)
        hidden = self._through(self.density_mlp, encoded)
        direction = self.direction_encoder(points.directions).to(hidden.dtype)
        direction = direction.expand(*hidden.shape[:-1], direction.shape[-1])
        raw_rgb = self._through(self.color_mlp, torch.cat([hidden, direction], dim=-1))
        density = self._density(hidden, points.positions)
        return FieldOutput(density=density, rgb=torch.sigmoid(raw_rgb.float()))

    def reset_parameters(self) -> None:
        """Draw every parameter anew from torch's generator."""
        self.position_encoder.reset_parameters()
        self.direction_encoder.reset_parameters()
        for weight in (*self.density_mlp, *self.color_mlp):
            nn.init.kaiming_uniform_(weight, a=5**0.5)

    def _through(self, weights: nn.ParameterList, features: Tensor) -> Tensor:
        out = mlp(features.flatten(0, -2), list(weights), self.products)
        return out.view(*features.shape[:-1], out.shape[-1])

    def _unit(self, positions: Tensor) -> Tensor:
        if self.contracted.is_on():
            # The ball of radius 2 fills the unit cube.
            return contract(in_unit_ball(positions, self.aabb)) / 4.0 + 0.5
        return to_unit_cube(positions, self.aabb)

    def _density(self, features: Tensor, positions: Tensor) -> Tensor:
        density = _TruncatedExponential.apply(features[..., 0].float() + self.bias)
        if self.contracted.is_on():
            return density
        center, half = center_and_half(self.aabb)
        return torch.where(((positions - center).abs() <= half).all(dim=-1), density, 0.0)


def _weights(*sizes: int) -> nn.ParameterList:
    return nn.ParameterList(torch.empty(after, before) for before, after in pairwise(sizes))


class _TruncatedExponential(torch.autograd.Function):
    """exp(x), whose gradient stops growing at exp(15): one wild sample must not end the run."""

    @staticmethod
    def forward(ctx: Any, raw: Tensor) -> Tensor:
        ctx.save_for_backward(raw)
        return torch.exp(raw.clamp(max=2 * LARGEST_EXPONENT))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (raw,) = ctx.saved_tensors
        return grad * torch.exp(raw.clamp(-LARGEST_EXPONENT, LARGEST_EXPONENT))

"""Two small MLPs on top of an encoder of the unit cube (Sec. 5.4, arXiv 2201.05989).

Widths and layers: `conf/field/ngp.yaml` and its variants. Density and color from raw outputs: `nerf/activations.py`.
"""

from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nerf_lightning.messages.errors import ANOTHER, InputError
from nerf_lightning.nerf.activations import LEAST_SLOPE, color_from, density_from
from nerf_lightning.nerf.encoders.base import ConeEncoder, Encoder, require_direction_encoder
from nerf_lightning.nerf.fields.base import Field, HiddenLayer
from nerf_lightning.nerf.geometry.boxes import center_and_half, require_box, to_unit_cube
from nerf_lightning.nerf.geometry.cones import contracted_covariance, scaled_covariance
from nerf_lightning.nerf.geometry.contraction import Contracted, contract, in_unit_ball
from nerf_lightning.nerf.kernels.mlp.op import mlp
from nerf_lightning.nerf.kernels.render.op import FieldParts
from nerf_lightning.nerf.matmul_precision import linear
from nerf_lightning.nerf.ranges import require_ranges
from nerf_lightning.nerf.types.rays import Points
from nerf_lightning.nerf.types.renderings import FieldOutput
from nerf_lightning.nerf.types.scene import Scene

THICK, THIN = 3.0, -1.0


class NGPField(Field):
    """Density from an MLP with one hidden layer, color from one that sees the direction; exponential density.

    Positions are mapped from the scene's box, or from contracted space, to the unit cube. Without contraction, space
    outside the box is empty.

    Args:
        position_encoder: features of points in the unit cube.
        direction_encoder: features of unit directions.
        width: width of every hidden layer.
        feature_dim: outputs of the density MLP that the color MLP receives, including the raw density.
        color_layers: hidden layers of the color MLP. Two as in arXiv 2201.05989; one is a tenth faster, as sharp after
            a minute of training on two cores, and less sharp after many.
        density_bias: added to the raw density before the exponential. None: dense (3) if the photographs have alpha,
            which shows early what is empty, and thin (-1) otherwise, because a dense start would remain as fog in the
            background's color.
        contraction: map all space, contracted around the box, instead of only the box; None: as the scene's space.
        appearance: size of the appearance embedding of each photograph (Sec. 4.1, arXiv 2008.02268); 0: none. New views
            use the mean embedding of the training photographs.
    """

    compiles = False

    aabb: Tensor
    bias: Tensor
    codes: Tensor
    trained: Tensor

    def __init__(
        self,
        position_encoder: Encoder,
        direction_encoder: Encoder,
        width: int = 64,
        feature_dim: int = 16,
        color_layers: int = 2,
        density_bias: float | None = None,
        contraction: bool | None = None,
        appearance: int = 0,
    ):
        super().__init__()
        sizes = {
            "width": (1, 1 << 20),
            "feature_dim": (1, 1 << 20),
            "color_layers": (1, 64),
            "appearance": (0, 1 << 10),
        }
        require_ranges(locals(), sizes)
        require_direction_encoder(direction_encoder)
        self.position_encoder = position_encoder
        self.direction_encoder = direction_encoder
        self.sees_cones = isinstance(position_encoder, ConeEncoder) and position_encoder.sees_cones
        self.density_bias = density_bias
        self.least_slope = 0.0
        self.contracted = Contracted(contraction)
        # Reading the buffer stalls a GPU, so it is read once.
        self._known_bias: float | None = None
        self.register_buffer("bias", torch.tensor(THIN if density_bias is None else float(density_bias)))
        self.register_buffer("aabb", torch.tensor([[-1.0] * 3, [1.0] * 3]))
        self.density_mlp = _weights(position_encoder.out_dim, width, feature_dim)
        self.color_mlp = _weights(feature_dim + direction_encoder.out_dim + appearance, *[width] * color_layers, 3)
        self.appearance = appearance
        if appearance:
            self.codes = nn.Parameter(torch.zeros(1, appearance))
            self.register_buffer("trained", torch.zeros(1, dtype=torch.int64))
        self.reset_parameters()

    def fit_to(self, scene: Scene) -> None:
        """Record the box of the scene's content, whether the photographs have alpha, and how many are trained on.

        Raises:
            InputError: an appearance embedding was requested, but there is only one photograph.
        """
        self.aabb.copy_(scene.aabb)
        self.contracted.fit_to(scene)
        if self.appearance:
            if len(scene.splits["train"]) < 2:
                raise InputError(
                    f"The scene {scene.name} trains on one photograph, and codes learn how the colors of several "
                    "differ: add field.appearance=0, or give more photographs."
                )
            self.codes = nn.Parameter(torch.zeros(len(scene.view_names), self.appearance))
            self.trained = torch.tensor(scene.splits["train"])
        self.least_slope = 0.0 if scene.pixels.has_transparency else LEAST_SLOPE
        if self.density_bias is None:
            self.bias.fill_(THICK if scene.pixels.has_transparency else THIN)
        self._known_bias = None

    def validate_state(self) -> None:
        """Check the loaded state.

        Raises:
            InputError: an empty box, or embeddings of views that do not exist.
        """
        require_box(self.aabb)
        if self.appearance and not bool(((self.trained >= 0) & (self.trained < len(self.codes))).all()):
            raise InputError(f"The photographs that have codes in the field's state are none. {ANOTHER}")

    def density(self, points: Points) -> tuple[Float[Tensor, "*points"], Float[Tensor, "*points features"]]:
        """Return the density per unit length, and the encoder's features."""
        encoded = self._encoded(points, None)
        return self._density(self._through(self.density_mlp, encoded), points.positions), encoded

    def forward(self, points: Points, features: Float[Tensor, "*points features"] | None = None) -> FieldOutput:
        """Return density and color; density does not depend on the direction."""
        hidden = self._through(self.density_mlp, self._encoded(points, features))
        raw_rgb = self._through(self.color_mlp, self._with_direction(hidden, points))
        density = self._density(hidden, points.positions)
        raw_rgb = raw_rgb.float()
        rgb = color_from(raw_rgb, self.least_slope)
        return FieldOutput(density=density, rgb=rgb)

    def hidden_layers(self) -> list[HiddenLayer]:
        """Return the hidden layers of the density's MLP and of the color's."""
        sizes = {"density_mlp": len(self.density_mlp), "color_mlp": len(self.color_mlp)}
        return [
            HiddenLayer((f"{name}.{number}",), (f"{name}.{number + 1}",))
            for name, count in sizes.items()
            for number in range(count - 1)
        ]

    def hidden_activations(self, points: Points) -> list[Float[Tensor, "*points neurons"]]:
        """Return the activations of `hidden_layers`, layer by layer."""
        *density, features = _layer_by_layer(self.density_mlp, self._encoded(points, None))
        return [*density, *_layer_by_layer(self.color_mlp, self._with_direction(features, points))[:-1]]

    def parts(self) -> FieldParts | None:
        """Return what whole-ray kernels compute with; None unless the encoder is exactly a grid lookup.

        With hooks on the field it is also None, so that they see every call.
        """
        grid, hooks = self.position_encoder.grid(), (*self._forward_hooks, *self._forward_pre_hooks)
        if grid is None or hooks or type(self) is not NGPField:  # a subclass may compute something else
            return None
        if self._known_bias is None:
            self._known_bias = float(self.bias)
        return FieldParts(
            self.aabb,
            *grid,
            self._known_bias,
            list(self.density_mlp),
            list(self.color_mlp),
            lambda rays: self._shared_along(Points(rays.origins, rays.view_directions, rays.photograph)),
            self.least_slope,
            self.contracted.is_on(),
            ray_features_learn=bool(self.appearance or list(self.direction_encoder.parameters())),
        )

    def reset_parameters(self) -> None:
        """Reinitialize every parameter from torch's generator."""
        self.position_encoder.reset_parameters()
        self.direction_encoder.reset_parameters()
        for weight in (*self.density_mlp, *self.color_mlp):
            nn.init.kaiming_uniform_(weight, a=5**0.5)
        if self.appearance:
            nn.init.zeros_(self.codes)

    def _with_direction(self, features: Tensor, points: Points) -> Tensor:
        """Return the color MLP's input: the density MLP's features, the direction, and the appearance embedding."""
        shared = self._shared_along(points).to(features.dtype)
        return torch.cat([features, shared.expand(*features.shape[:-1], shared.shape[-1])], dim=-1)

    def _shared_along(self, points: Points) -> Float[Tensor, "*#points features"]:
        """Return what all samples of a ray share: the features of the direction, and the appearance embedding."""
        direction = self.direction_encoder(points.directions)
        if not self.appearance:
            return direction
        code = self._code(points).to(direction.dtype)
        return torch.cat([direction, code.expand(*direction.shape[:-1], self.appearance)], dim=-1)

    def _code(self, points: Points) -> Tensor:
        return self.codes[self.trained].mean(dim=0) if points.photograph is None else self.codes[points.photograph]

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        # As many photographs as the checkpoint's run had, which a newly built field does not know.
        codes, trained = state_dict.get(f"{prefix}codes"), state_dict.get(f"{prefix}trained")
        if codes is not None and trained is not None and codes.shape[1:] == (self.appearance,) and trained.ndim == 1:
            self.codes.data = self.codes.new_zeros(len(codes), self.appearance)
            self.trained = self.trained.new_zeros(len(trained))
        self._known_bias = None
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    def _through(self, weights: nn.ParameterList, features: Tensor) -> Tensor:
        out = mlp(features.flatten(0, -2), list(weights), self.matmul_precision)
        return out.view(*features.shape[:-1], out.shape[-1])

    def _encoded(self, points: Points, cached: Tensor | None) -> Tensor:
        encoder, unit = self.position_encoder, self._unit(points.positions)
        if isinstance(encoder, ConeEncoder) and encoder.sees_cones and points.covariance is not None:
            covariance = self._unit_covariance(points.covariance, points.positions)
            return encoder(unit, covariance) if cached is None else encoder.attach_gradients(unit, cached, covariance)
        return encoder(unit) if cached is None else encoder.attach_gradients(unit, cached)

    def _unit(self, positions: Tensor) -> Tensor:
        if self.contracted.is_on():
            # The ball of radius 2 fills the unit cube.
            return contract(in_unit_ball(positions, self.aabb)) / 4.0 + 0.5
        return to_unit_cube(positions, self.aabb)

    @torch.no_grad()
    def _unit_covariance(self, covariance: Tensor, positions: Tensor) -> Tensor:
        to_cube = 1.0 / (self.aabb[1] - self.aabb[0])
        if self.contracted.is_on():
            covariance = scaled_covariance(covariance, 2.0 / 3**0.5 * to_cube)
            covariance = contracted_covariance(covariance, in_unit_ball(positions, self.aabb))
            to_cube = torch.full_like(to_cube, 0.25)
        return scaled_covariance(covariance, to_cube)

    def _density(self, features: Tensor, positions: Tensor) -> Tensor:
        density = density_from(features[..., 0].float() + self.bias)
        if self.contracted.is_on():
            return density
        center, half = center_and_half(self.aabb)
        return torch.where(((positions - center).abs() <= half).all(dim=-1), density, 0.0)


def _weights(*sizes: int) -> nn.ParameterList:
    return nn.ParameterList(torch.empty(after, before) for before, after in pairwise(sizes))


def _layer_by_layer(weights: nn.ParameterList, features: Tensor) -> list[Tensor]:
    """Return what `kernels.mlp` computes, with all intermediate layers."""
    layers = []
    for number, weight in enumerate(weights):
        features = linear(features if not number else functional.relu(features), weight, None, "float32")
        layers.append(features)
    return [*(functional.relu(layer) for layer in layers[:-1]), layers[-1]]

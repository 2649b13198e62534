"""The MLP of the original NeRF (Fig. 7, arXiv 2003.08934).

Depths and widths: `conf/field/nerf_mlp.yaml` and its variants. Octaves: `conf/encoder/`.
"""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nerf_lightning.nerf.encoders.base import Encoder, require_direction_encoder
from nerf_lightning.nerf.fields.base import Field, HiddenLayer
from nerf_lightning.nerf.fields.batch_norm import BatchNorm
from nerf_lightning.nerf.geometry.boxes import require_box
from nerf_lightning.nerf.geometry.contraction import Contracted, contract, in_unit_ball
from nerf_lightning.nerf.matmul_precision import Linear, linear
from nerf_lightning.nerf.ranges import require_ranges
from nerf_lightning.nerf.types.rays import Points
from nerf_lightning.nerf.types.renderings import FieldOutput
from nerf_lightning.nerf.types.scene import Scene

MOST_LAYERS = 100


class NerfMLP(Field):
    """Eight layers of 256 with one skip; density before the direction enters; a 128-wide color head.

    Args:
        position_encoder: features of positions, gamma(x).
        direction_encoder: features of directions, gamma(d).
        depth: number of trunk layers.
        width: width of the trunk and of the feature; the color head has half of it.
        skip: index of the trunk layer (counted from 0) whose input is joined by the encoded position again; the
            paper's is 5, after the layer at index 4. None for no skip.
        density_activation: relu as in the paper, or softplus, whose gradient never vanishes.
        density_bias: added to the raw density before its activation; negative values start from empty space.
        density_noise: standard deviation of the Gaussian noise added to the raw density in training.
        xavier: Glorot uniform weights and zero biases, as in Keras; False: PyTorch's own initialization.
        batch_norm: normalize every hidden layer over all samples of a step (the article's `bn`). Training
            then takes whole batches, whatever `trainer.tile_points`, in one process.
        contraction: contract all space around the scene's box into a ball of radius 2; None: as the scene's space.
            Otherwise positions enter unchanged, as in the paper.
    """

    aabb: Tensor

    def __init__(
        self,
        position_encoder: Encoder,
        direction_encoder: Encoder,
        depth: int = 8,
        width: int = 256,
        skip: int | None = 5,
        density_activation: Literal["relu", "softplus"] = "relu",
        density_bias: float = 0.0,
        density_noise: float = 0.0,
        xavier: bool = True,
        batch_norm: bool = False,
        contraction: bool | None = None,
    ):
        super().__init__()
        if not 1 <= depth <= MOST_LAYERS:
            raise ValueError(f"depth={depth}: give 1 to {MOST_LAYERS} layers")
        require_ranges({"width": width}, {"width": (2, 1 << 20)})
        if skip is not None and not 0 < skip < depth:
            raise ValueError(f"skip={skip} names no layer between 1 and {depth - 1}")
        if position_encoder.needs_unit_cube:
            raise ValueError(f"{type(position_encoder).__name__} needs a field that knows the scene's box: field=ngp")
        require_direction_encoder(direction_encoder)
        self.position_encoder = position_encoder
        self.direction_encoder = direction_encoder
        self.skip = skip
        self.density_activation = density_activation
        self.density_bias = density_bias
        self.density_noise = density_noise
        self.xavier, self.batch_norm = xavier, batch_norm
        self.contracted = Contracted(contraction)
        self.register_buffer("aabb", torch.tensor([[-1.0] * 3, [1.0] * 3]))
        inputs = position_encoder.out_dim
        sizes = [inputs] + [width] * (depth - 1)
        if skip is not None:
            sizes[skip] += inputs
        self.trunk = nn.ModuleList(_hidden(size, width, batch_norm) for size in sizes)
        self.density_head = nn.Linear(width, 1)
        self.feature = Linear(width, width)
        self.color_hidden = _hidden(width + direction_encoder.out_dim, width // 2, batch_norm)
        self.color_head = nn.Linear(width // 2, 3)
        self.reset_parameters()

    def fit_to(self, scene: Scene) -> None:
        """Record the scene's space and box."""
        self.contracted.fit_to(scene)
        self.aabb.copy_(scene.aabb)

    def validate_state(self) -> None:
        """Check the loaded state.

        Raises:
            InputError: an empty box.
        """
        require_box(self.aabb)

    def density(self, points: Points) -> tuple[Float[Tensor, "*points"], None]:
        """Return the density per unit length, without computing color."""
        return self._activate(_exactly(self.density_head, self._trunk(points.positions))[..., 0], None), None

    def forward(self, points: Points, features: Tensor | None = None) -> FieldOutput:
        """Return density and color; density does not depend on the direction. `features` is unused."""
        hidden = self._trunk(points.positions)
        raw_density = _exactly(self.density_head, hidden)[..., 0]
        feature = self.color_feature(hidden, points)
        # Encoded once per ray, not once per sample.
        direction = self.direction_encoder(points.directions).to(feature.dtype)
        direction = direction.expand(*feature.shape[:-1], direction.shape[-1])
        joined = torch.cat([feature, direction], dim=-1)
        rows = joined.reshape(-1, joined.shape[-1])
        raw_rgb = _exactly(self.color_head, self.color_hidden(rows)).view(*feature.shape[:-1], 3)
        noise = None
        if points.random is not None and self.density_noise > 0:
            noise = self.density_noise * points.random.normal("density_noise")
        return FieldOutput(density=self._activate(raw_density, noise), rgb=torch.sigmoid(raw_rgb.float()))

    def color_feature(self, hidden: Float[Tensor, "*points width"], points: Points) -> Float[Tensor, "*points width"]:
        """Return the color's input besides the direction; a derived field may add to it."""
        return self.feature(hidden)

    def hidden_layers(self) -> list[HiddenLayer]:
        """Return the layers of the trunk, the feature and the color; encodings that join them come after them."""
        following = ((f"trunk.{number}.0.weight",) for number in range(1, len(self.trunk)))
        readers = (*following, ("density_head.weight", "feature.weight"))
        trunk = [HiddenLayer(self._rows(f"trunk.{number}"), each) for number, each in enumerate(readers)]
        feature = HiddenLayer(("feature.weight", "feature.bias"), ("color_hidden.0.weight",))
        return [*trunk, feature, HiddenLayer(self._rows("color_hidden"), ("color_head.weight",))]

    def hidden_activations(self, points: Points) -> list[Float[Tensor, "*points neurons"]]:
        """Return the activations of `hidden_layers`, layer by layer."""
        found: list[Tensor] = []
        layers = (*self.trunk, self.feature, self.color_hidden)
        hooks = [layer.register_forward_hook(lambda _, inputs, output: found.append(output)) for layer in layers]
        try:
            self(points)
        finally:
            for hook in hooks:
                hook.remove()
        return found

    def reset_parameters(self) -> None:
        """Reinitialize every parameter from torch's generator."""
        self.position_encoder.reset_parameters()
        self.direction_encoder.reset_parameters()
        for module in self.modules():
            if isinstance(module, nn.Linear):
                module.reset_parameters()
                if self.xavier:
                    nn.init.xavier_uniform_(module.weight)
                    nn.init.zeros_(module.bias)
            elif isinstance(module, BatchNorm):
                module.reset_parameters()

    def _rows(self, layer: str) -> tuple[str, ...]:
        normalized = ("weight", "bias", "running_mean", "running_variance") if self.batch_norm else ()
        return f"{layer}.0.weight", f"{layer}.0.bias", *(f"{layer}.1.{name}" for name in normalized)

    def _trunk(self, positions: Tensor) -> Tensor:
        if self.contracted.is_on():
            positions = contract(in_unit_ball(positions, self.aabb))
        # As rows: torch multiplies rows anyway, and an in-place ReLU on a view of them would copy its gradients.
        encoded = self.position_encoder(positions.reshape(-1, 3))
        hidden = encoded
        for index, layer in enumerate(self.trunk):
            if index == self.skip:
                hidden = torch.cat([hidden, encoded.to(hidden.dtype)], dim=-1)
            hidden = layer(hidden)
        return hidden.view(*positions.shape[:-1], hidden.shape[-1])

    def _activate(self, raw: Tensor, noise: Tensor | None) -> Tensor:
        # Densities are multiplied by lengths of 1e-3 and enter exponentials: always float32.
        raw = raw.float() + self.density_bias
        if noise is not None:
            raw = raw + noise
        return functional.relu(raw) if self.density_activation == "relu" else functional.softplus(raw)


def _exactly(head: nn.Linear, features: Tensor) -> Tensor:
    # With so few outputs float32 costs nothing, and densities and colors keep their digits.
    return linear(features, head.weight, head.bias, "float32")


def _hidden(inputs: int, outputs: int, batch_norm: bool) -> nn.Sequential:
    normalized = [BatchNorm(outputs)] if batch_norm else []
    return nn.Sequential(Linear(inputs, outputs), *normalized, nn.ReLU(inplace=True))

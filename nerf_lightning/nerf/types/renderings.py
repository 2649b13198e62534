"""The output of a field at points, and of a level along rays."""

from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.types.rays import RaggedSamples, RayBundle, RaySamples
from nerf_lightning.nerf.types.tensor_struct import TensorStruct

Kind = TypeVar("Kind", bound="Rendering")


@dataclass(frozen=True)
class FieldOutput(TensorStruct):
    """The output of a field at points in space."""

    density: Float[Tensor, "*points"]
    """Per unit length, >= 0."""
    rgb: Float[Tensor, "*points 3"]
    """In [0, 1]."""
    channels: dict[str, Float[Tensor, "*points _"]] = field(default_factory=dict, kw_only=True)
    """Other outputs of a field (features, classes, normals), by name; composited and rendered like color."""


@dataclass(frozen=True)
class Rendering(TensorStruct):
    """What one level rendered along each ray."""

    rgb: Float[Tensor, "*rays 3"]
    """Composited over the background, exactly once."""
    foreground: Float[Tensor, "*rays 3"]
    """The scene's own light, before the background: sum of weights times color."""
    opacity: Float[Tensor, "*rays"]
    """Sum of weights."""
    depth: Float[Tensor, "*rays"]
    """Expected distance along the ray; light that escapes ends at far."""
    penalty: Float[Tensor, "*rays"] | None = field(default=None, kw_only=True)
    """What a level adds to the loss of each ray in training, for any loss; None: nothing."""
    channels: dict[str, Float[Tensor, "*rays _"]] = field(default_factory=dict, kw_only=True)
    """The field's channels, composited like color over nothing: sums of weights times values."""

    @classmethod
    def from_sums(
        cls: type[Kind],
        rays: RayBundle,
        background: Float[Tensor, "*#rays 3"] | None,
        foreground: Float[Tensor, "*rays 3"],
        opacity: Float[Tensor, "*rays"],
        depth: Float[Tensor, "*rays"],
        **of_the_kind: Any,
    ) -> Kind:
        """Return the rendering, given per ray sum of w rgb, sum of w and sum of w t, and the fields of the subclass.

        Light that escapes belongs to the background and, in the depth, to far.
        """
        escaped = 1.0 - opacity
        return cls(
            rgb=foreground if background is None else torch.addcmul(foreground, escaped[..., None], background),
            foreground=foreground,
            opacity=opacity,
            depth=torch.addcmul(depth, escaped, rays.far),
            **of_the_kind,
        )

    @classmethod
    def from_light(
        cls,
        rays: RayBundle,
        background: Float[Tensor, "*rays 3"] | None,
        foreground: Float[Tensor, "*rays 3"],
        light: Float[Tensor, "*rays"],
        depth: Float[Tensor, "*rays"],
        channels: dict[str, Tensor] | None = None,
    ) -> "Rendering":
        """Return the rendering, given the light that escapes (transmittance at the end) and the sum of w t."""
        return cls(
            rgb=foreground if background is None else foreground + light[..., None] * background,
            foreground=foreground,
            opacity=1.0 - light,
            depth=depth + light * rays.far,
            channels=channels or {},
        )


@dataclass(frozen=True)
class DenseRendering(Rendering):
    """The rendering of a level whose rays all have the same number of samples."""

    weights: Float[Tensor, "*rays samples"]
    samples: RaySamples


@dataclass(frozen=True)
class RaggedRendering(Rendering):
    """The rendering of a level that skips empty space."""

    weights: Float[Tensor, "capacity"]
    samples: RaggedSamples

"""What a field says of points, and what a level makes of it along each ray."""

from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.types.rays import PackedSamples, RaySamples
from nerf_lightning.nerf.types.tensor_struct import TensorStruct


@dataclass(frozen=True)
class FieldOutput(TensorStruct):
    """What a field says of points in space."""

    density: Float[Tensor, "*points"]
    """Per unit length, >= 0."""
    rgb: Float[Tensor, "*points 3"]
    """In [0, 1]."""


@dataclass(frozen=True)
class Rendering(TensorStruct):
    """What one level saw along each ray."""

    rgb: Float[Tensor, "*rays 3"]
    """Composited over the background, exactly once."""
    foreground: Float[Tensor, "*rays 3"]
    """The scene's own light, before the background: sum of weights times colour."""
    opacity: Float[Tensor, "*rays"]
    """Sum of weights."""
    depth: Float[Tensor, "*rays"]
    """Expected distance along the ray; light that escapes ends at far."""
    penalty: Float[Tensor, "*rays"] | None = field(default=None, kw_only=True)
    """What a level in training adds to the loss of each ray, whatever the loss; None: nothing."""


@dataclass(frozen=True)
class DenseRendering(Rendering):
    """A level whose rays all have the same number of samples."""

    weights: Float[Tensor, "*rays samples"]
    samples: RaySamples


@dataclass(frozen=True)
class PackedRendering(Rendering):
    """A level that skipped what is empty."""

    weights: Float[Tensor, "capacity"]
    samples: PackedSamples

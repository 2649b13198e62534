"""Surfaces as depth maps: where a ray has half of its light behind it, and which way the surface faces there."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

_SEEN = 1e-3
"""Opacity below which a ray met nothing: what is left of its depth is rounding."""


def surface_depth(
    depth: Float[Tensor, "*rays"], opacity: Float[Tensor, "*rays"], far: Float[Tensor, "*rays"]
) -> Float[Tensor, "*rays"]:
    """Return the expected distance of the light that was stopped: (depth - (1 - opacity) far) / opacity.

    A rendering's depth lets the light that escapes end at far; here its share is taken out. A ray that met
    nothing (opacity below 0.001) ends at far.
    """
    met = opacity > _SEEN
    return torch.where(met, (depth - (1 - opacity) * far) / torch.where(met, opacity, 1.0), far)


def normals_from_depth(points: Float[Tensor, "height width 3"]) -> Float[Tensor, "height width 3"]:
    """Return unit normals, facing the camera, of a surface given as each pixel's point (world axes).

    The cross product of central differences, one-sided at the border; zero where they are parallel. With row
    0 on top, (down the rows) x (along the columns) points towards the camera for whatever a pinhole sees, so
    no pose is needed. The picture must be at least two pixels high and wide.
    """
    down, along = torch.gradient(points, dim=(0, 1))
    return normalize(torch.linalg.cross(down, along), dim=-1)

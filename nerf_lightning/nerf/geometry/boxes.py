"""Axis-aligned boxes; `kernels/march/cuda.py` repeats `distances_in_box`."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.messages.errors import ANOTHER, InputError
from nerf_lightning.nerf.kernels.backends import with_kernel
from nerf_lightning.nerf.types.rays import RayBundle


def require_box(aabb: Float[Tensor, "2 3"]) -> None:
    """Refuse an empty box from a file.

    Raises:
        InputError: the lower corner is not below the upper one.
    """
    if not bool((aabb[0] < aabb[1]).all()):
        raise InputError(
            f"The box in the model's state reaches from {aabb[0].tolist()} to {aabb[1].tolist()}. {ANOTHER}"
        )


def to_unit_cube(positions: Float[Tensor, "*points 3"], aabb: Float[Tensor, "2 3"]) -> Float[Tensor, "*points 3"]:
    """Map a box onto the unit cube.

    >>> to_unit_cube(torch.tensor([0.0, 1.0, 3.0]), torch.tensor([[-1.0, -1, -1], [3, 3, 3]]))
    tensor([0.2500, 0.5000, 1.0000])
    """
    return (positions - aabb[0]) / (aabb[1] - aabb[0])


def center_and_half(aabb: Float[Tensor, "2 3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Return a box's center and half of its sides.

    >>> center_and_half(torch.tensor([[-1.0, 0, 2], [3, 1, 2]]))
    (tensor([1.0000, 0.5000, 2.0000]), tensor([2.0000, 0.5000, 0.0000]))
    """
    return aabb.mean(dim=0), 0.5 * (aabb[1] - aabb[0])


@with_kernel("march.cuda")
def distances_in_box(
    rays: RayBundle, aabb: Float[Tensor, "2 3"]
) -> tuple[Float[Tensor, "*rays"], Float[Tensor, "*rays"]]:
    """Return where each ray enters and leaves a box, within its near and far; on a miss the first is not smaller."""
    # Division by exactly zero gives infinities, which compare correctly, but NaN on a face.
    inverse = 1.0 / torch.where(rays.directions == 0, 1e-20, rays.directions)
    a, b = (aabb[0] - rays.origins) * inverse, (aabb[1] - rays.origins) * inverse
    enter = torch.minimum(a, b).amax(dim=-1)
    leave = torch.maximum(a, b).amin(dim=-1)
    return torch.maximum(enter, rays.near), torch.minimum(leave, rays.far)

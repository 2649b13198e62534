"""All of space in a cube: the scene's own box as it is, and what lies around it in a coarser shell."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.nerf.types.scene import SceneRecord

EVEN = 16  # Blocks have to end where the inner cube does, at a quarter of the grid.
SHARE = 0.75  # Of the voxels that a scene in a box would have along its side: as many again lie around it.
EDGE = 1e-4  # Rounding, in places of the cube.


@dataclass(frozen=True)
class Contraction:
    """The inner cube, and how close to a camera the field begins (`voxel_kernels.contracted` has the equation)."""

    center: tuple[float, float, float]
    """Scene frame."""
    half: float
    """Half of its side, scene units."""
    near: float
    """Scene units."""

    @classmethod
    def of(cls, record: SceneRecord) -> "Contraction":
        """Return the cube that just holds a scene's box."""
        x, y, z = record.aabb.mean(dim=0).tolist()
        return cls((x, y, z), float((record.aabb[1] - record.aabb[0]).max()) / 2, float(record.near.min()))

    def unit(self, world: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        """Return places of the scene in halves of the cube's side, from its middle."""
        return (world - torch.tensor(self.center)) / self.half

    def world(self, places: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        """Return where places of the contracted cube, -2 to 2, lie in the scene; its rim is at infinity: far away.

        >>> Contraction((0.0, 0.0, 0.0), 1.0, 0.1).world(torch.tensor([[0.5, 0.0, 1.0], [-1.75, 0.5, 0.0]])).tolist()
        [[0.5, 0.0, 1.0], [-4.0, 2.0, 0.0]]
        """
        r = self.radius(places)[..., None]
        largest = places.abs() >= places.abs().amax(dim=-1, keepdim=True).clamp(min=1.0)
        return torch.where(largest, places.sign() * r, places * r) * self.half + torch.tensor(self.center)

    def radius(self, places: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points"]:
        """Return max |u|, at least 1, of places of the contracted cube."""
        return 1.0 / (2.0 - places.abs().amax(dim=-1).clamp(1.0, 2.0 - EDGE))


def is_place(places: Float[Tensor, "*points 3"]) -> Bool[Tensor, "*points"]:
    """Tell which places of the contracted cube are any: not its rim, and not what lies on none of the inner faces."""
    beyond = places.abs() > 1.0 + EDGE
    return (beyond.sum(dim=-1) < 2) & (places.abs().amax(dim=-1) < 2.0 - EDGE)


def num_values(resolution: int) -> int:
    """Return the values along a side of the whole grid, for so many along the side of a box that holds a scene.

    >>> num_values(128), num_values(8)
    (192, 32)
    """
    return 2 * EVEN * max(1, round(SHARE * resolution / EVEN))

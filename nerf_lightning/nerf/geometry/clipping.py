"""Show part of a scene: rays cut to a box, or begun farther away."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.nerf.geometry.boxes import distances_in_box
from nerf_lightning.nerf.geometry.ndc import share_at_distance
from nerf_lightning.nerf.geometry.world_frame import points_from_user, unit_of
from nerf_lightning.nerf.matmul_precision import disable_autocast
from nerf_lightning.nerf.types.rays import RayBundle

# Farther than anything that a finite number of samples distinguishes from infinity.
ENDLESS = 1e9


@dataclass(frozen=True)
class CropBox:
    """A box along the axes of the capture's own frame, in the working frame."""

    corner: Float[Tensor, "3"]
    """The user's lower corner, in scene coordinates."""
    axes: Float[Tensor, "3 3"]
    """The user's axes as rows, in scene coordinates, of unit length."""
    size: Float[Tensor, "3"]
    """Lengths of the sides in scene units."""

    @classmethod
    def from_user(
        cls, lower: tuple[float, float, float], upper: tuple[float, float, float], to_user: Float[Tensor, "4 4"]
    ) -> "CropBox":
        """Return the box between two corners in the user's frame, the second one greater in every coordinate."""
        corners = torch.tensor([lower, upper], dtype=torch.float64)
        corner, unit = points_from_user(corners[:1], to_user.double())[0], unit_of(to_user.double())
        axes = to_user[:3, :3].double() / unit
        return cls(corner.float(), axes.float(), ((corners[1] - corners[0]) / unit).float())

    @disable_autocast
    def distances(self, rays: RayBundle) -> tuple[Float[Tensor, "*rays"], Float[Tensor, "*rays"]]:
        """Return where each ray enters and leaves the box, within its near and far; on a miss the second is smaller."""
        inside = replace(rays, origins=self._in_box(rays.origins), directions=rays.directions @ self.axes.mT)
        return distances_in_box(inside, torch.stack([torch.zeros_like(self.size), self.size]))

    def holds(self, points: Float[Tensor, "points 3"]) -> Bool[Tensor, "points"]:
        """Return which points are inside."""
        place = self._in_box(points)
        return ((place > 0) & (place < self.size)).all(dim=-1)

    @disable_autocast
    def _in_box(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        return (points - self.corner) @ self.axes.mT


@dataclass(frozen=True)
class Clip:
    """Where rays begin and end, if not as in training."""

    near: float | None = None
    """Distance from the camera in scene units; None: as in training."""
    box: CropBox | None = None
    """The box to show; None: everything."""

    def __call__(self, rays: RayBundle, straight: RayBundle, ndc: bool) -> RayBundle:
        """Return the clipped rays; if nothing is left of a ray, it ends where it begins.

        Args:
            rays: as the model takes them, through the world or through normalized device coordinates.
            straight: the same rays through the world.
            ndc: whether the two differ.
        """
        if ndc:
            zeros = torch.zeros_like(straight.near)
            near, far = self._in_world(replace(straight, near=zeros, far=zeros + ENDLESS))
            near, far = (rays.far * share_at_distance(straight, distance) for distance in (near, far))
        else:
            near, far = self._in_world(straight)
        return replace(rays, near=near, far=torch.maximum(near, far))

    def _in_world(self, rays: RayBundle) -> tuple[Tensor, Tensor]:
        if self.near is not None:
            rays = replace(rays, near=torch.full_like(rays.near, self.near))
        return (rays.near, rays.far) if self.box is None else self.box.distances(rays)

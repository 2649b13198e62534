"""What a page shows, computed without it: the same steps through the same bytes."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from nerf_lightning.export.baking.baked_field import LEAST_MET, NO_CHANGE, BakedField, tiles_of
from nerf_lightning.export.voxel_kernels.layout import kernels
from nerf_lightning.nerf.encoders.spherical_harmonics import SphericalHarmonicsEncoder
from nerf_lightning.nerf.types.rays import RayBundle

STEP = 0.5  # Voxels between two samples.


@dataclass(frozen=True)
class MarchedRays:
    """What rays meet."""

    rgb: Float[Tensor, "*rays 3"]
    """Without background: the light of what is there."""
    opacity: Float[Tensor, "*rays"]
    depth: Float[Tensor, "*rays"]
    """Distance at which the stopped light was stopped, scene units; 0 where none was."""
    num_densities: float
    """Samples of density per ray, and of color, on average."""
    num_colors: float


class Marcher:
    """Render a baked field."""

    def __init__(self, baked: BakedField):
        self.baked, self.index = baked, baked.index
        self.density = tiles_of(baked.density, self.index, empty=0)
        channels = range(len(baked.colors))
        tiles = [tiles_of(baked.channel(each), self.index, 0 if each < 3 else NO_CHANGE) for each in channels]
        self.colors = np.stack(tiles, axis=-1)

    def render(self, rays: RayBundle) -> MarchedRays:
        """Return what rays meet in the box, or in all of space."""
        shape, contraction = rays.near.shape, self.baked.contraction
        origins, directions, basis, lengths, way = self.in_grid(rays)
        field = (self.index, self.density, self.colors, self.baked.scale, STEP)
        least = lengths if contraction is None else contraction.near / contraction.half
        march = kernels("bounded" if contraction is None else "contracted").march_tiles
        found = march(origins, directions, basis, *field, least)
        columns = torch.from_numpy(found)
        depth = way * columns[:, 4] / columns[:, 3].clamp(min=1e-6)
        met = columns[:, 3:4].clamp(min=LEAST_MET) if self.baked.closed else torch.ones(1)
        columns[:, :4] /= met
        densities, colors = found[:, 5:].mean(axis=0).tolist()
        rgb, opacity = columns[:, :3].view(*shape, 3), columns[:, 3].view(shape)
        return MarchedRays(rgb, opacity, depth.view(shape), densities, colors)

    def in_grid(
        self, rays: RayBundle
    ) -> tuple[
        Float[ndarray, "rays 3"],
        Float[ndarray, "rays 3"],
        Float[ndarray, "rays basis"],
        Float[ndarray, "rays"],
        Float[Tensor, "rays"],
    ]:
        """Return origins, directions, spherical harmonics and lengths of rays, as kernels take them, and their ways.

        A way is how far a ray goes in the scene while it goes one in the grid.
        """
        contraction, unit = self.baked.contraction, torch.tensor(self.baked.spacing)
        apart = rays.origins - torch.tensor(self.baked.lower)
        if contraction is not None:
            unit = torch.full((3,), contraction.half)
            apart = rays.origins - torch.tensor(contraction.center)
        origins = (apart / unit).float().reshape(-1, 3).contiguous()
        along = rays.directions.float().reshape(-1, 3) / unit
        way = 1.0 / along.norm(dim=-1)
        directions, looks = along * way[:, None], rays.view_directions.float().reshape(-1, 3)
        lengths = way / self.baked.length
        if contraction is not None:
            lengths = torch.full_like(way, contraction.near / contraction.half)
        basis = SphericalHarmonicsEncoder(math.isqrt(self.baked.num_harmonics))(looks)
        return origins.numpy(), directions.contiguous().numpy(), basis.contiguous().numpy(), lengths.numpy(), way

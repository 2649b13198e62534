"""The colors of voxels as spherical harmonics, fitted to what the field says in the directions they are seen from."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray
from torch import Tensor
from torch.nn import functional

from nerf_lightning.export.baking.baked_field import NO_CHANGE
from nerf_lightning.export.baking.density import DensityGrid
from nerf_lightning.export.density_grid import Report
from nerf_lightning.export.voxel_kernels.layout import kernels
from nerf_lightning.nerf.encoders.spherical_harmonics import DEGREE_1, SphericalHarmonicsEncoder
from nerf_lightning.nerf.geometry.cameras import coarse_pixels, rays_through_pixels
from nerf_lightning.nerf.models.base import Model, point_field
from nerf_lightning.nerf.models.tiles import tiles
from nerf_lightning.nerf.types.points import Points
from nerf_lightning.nerf.types.scene import SceneRecord

# Of each voxel, so many cameras that see it are asked, and so many in all to find them.
LOOKS, TRIES = {1: 4, 4: 10, 9: 12}, 48
# Without bounds, where most voxels lie behind walls and all are asked in vain, and where more looks change little.
TRIES_AROUND, LOOKS_AROUND = 24, 4
RIDGE = 0.02  # What holds back coefficients of degree 1 and 2, as a share of a voxel's light.
RANGES = (0.6, 0.6)  # Half range of the bytes of coefficients, of degree 1 and of degree 2.
# Their bytes are multiples of this: such small changes are not seen, and few different bytes are packed well.
COARSE = 8
MARGIN = 0.02  # The part of a view's cone that a grid of pixels over it may miss.
SHARPER = 0.5  # How much more colors differ from their neighbors' than the field's.
LEAST_DISPARITY = 1e-3  # In normalized device coordinates, from the far end.


@dataclass(frozen=True)
class SeenVoxels:
    """Voxels at which light from the scene's things may be stopped, and who sees them."""

    voxels: Int[ndarray, "voxels 3"]
    world: Float[Tensor, "voxels 3"]
    """Where they lie in the world."""
    cameras: Int[ndarray, "voxels looks"]
    """Numbers of training cameras that see each; -1: no more."""
    light: Float[ndarray, "voxels looks"]
    """How much of its light arrives there."""

    def only(self, which: Bool[ndarray, "voxels"]) -> "SeenVoxels":
        """Return some of them."""
        world = self.world[torch.from_numpy(which)]
        return SeenVoxels(self.voxels[which], world, self.cameras[which], self.light[which])


def who_sees(
    grid: DensityGrid, voxels: Int[ndarray, "voxels 3"], record: SceneRecord, num_harmonics: int, report: Report
) -> SeenVoxels:
    """Ask which cameras see what is dense, and the air next to it, whose colors are mixed in."""
    world = _in_world(grid.places(voxels), record)
    eyes, views = _camera_views(record)
    contraction, spacing = grid.contraction, grid.spacing.numpy()
    given = (grid.optical, voxels, world.numpy())
    if contraction is not None:
        units, eyes_of = contraction.unit(world).numpy(), contraction.unit(torch.from_numpy(eyes[:, :3])).numpy()
        asked = (units, eyes_of, views, contraction.near / contraction.half, LOOKS_AROUND, TRIES_AROUND)
        cameras, light = kernels("contracted").seeing_cameras(*given, *asked)
    else:
        in_grid = np.concatenate([(eyes[:, :3] - eyes[:, 3:] * grid.lower.numpy()) / spacing, eyes[:, 3:]], axis=1)
        seen_in = (in_grid.astype(np.float32), views, (spacing / spacing.max()).astype(np.float32))
        cameras, light = kernels("bounded").seeing_cameras(*given, *seen_in, LOOKS[num_harmonics], TRIES)
    report("seen", 1.0)
    return SeenVoxels(voxels, world, cameras, light)


def _camera_views(record: SceneRecord) -> tuple[Float[ndarray, "cameras 4"], Float[ndarray, "cameras 7"]]:
    """Return where the training cameras are in the field's space, homogeneous, and their cones in the world.

    A cone is a center, an axis and the cosine of the widest angle. The way from a place p to a camera is xyz - w p:
    normalized device coordinates keep straight lines, and may put a camera beyond infinity.
    """
    train = list(record.splits["train"])
    cameras, none = record.cameras, torch.zeros(len(record.near))
    pixels = coarse_pixels(cameras).map(lambda each: each[train])
    rays = rays_through_pixels(replace(cameras, ndc=None), pixels, none, none + 1.0)
    axis, centers = -cameras.c2w[train, :, 2], cameras.c2w[train, :, 3]
    cosine = (rays.directions * axis[:, None]).sum(dim=-1).amin(dim=1, keepdim=True) - MARGIN
    eyes = torch.cat([centers, torch.ones(len(train), 1)], dim=1)
    if cameras.ndc is not None:
        x, y, z = centers.unbind(dim=-1)
        a_x, a_y = cameras.ndc[0]
        eyes = torch.stack([a_x * x, a_y * y, -(z + 2.0), -z], dim=-1)
    return eyes.float().numpy(), torch.cat([centers, axis, cosine], dim=1).float().numpy()


def _in_world(places: Float[Tensor, "voxels 3"], record: SceneRecord) -> Float[Tensor, "voxels 3"]:
    """Return where places of the field's space lie in the world; what is at infinity, far away."""
    if record.cameras.ndc is None:
        return places
    z = 2.0 / (places[:, 2:] - 1.0).clamp(max=-LEAST_DISPARITY)
    return torch.cat([-places[:, :2] * z / record.cameras.ndc[0], z], dim=1)


def fitted_colors(
    model: Model,
    record: SceneRecord,
    grid: DensityGrid,
    seen: SeenVoxels,
    num_harmonics: int,
    tile_points: int,
    report: Report,
) -> Float[Tensor, "voxels harmonics 3"]:
    """Return the coefficients (1, 4 or 9) that fit the last level's colors best, weighted by the light that arrives.

    min_c sum_k w_k |Y(d_k) c - rgb(d_k)|^2 + ridge |c_{l > 0}|^2 sum_k w_k, for each voxel and channel; then
    `sharpened`.
    """
    device = next(model.parameters()).device
    harmonics = SphericalHarmonicsEncoder(math.isqrt(num_harmonics))
    places, centers = grid.places(seen.voxels), record.cameras.c2w[list(record.splits["train"]), :, 3]
    looks = seen.cameras.shape[1]
    ridge = RIDGE * torch.eye(num_harmonics)
    ridge[0, 0] = 1e-6
    fitted = torch.empty(len(places), num_harmonics, 3)
    for part in tiles(len(places), max(1, tile_points // looks)):
        chosen = torch.from_numpy(seen.cameras[part]).long()
        weight = torch.from_numpy(seen.light[part]) * (chosen >= 0)
        at = places[part, None].expand(-1, looks, -1)
        directions = functional.normalize(seen.world[part, None] - centers[chosen], dim=-1)
        asked = (chosen >= 0).flatten()
        points = Points(at.flatten(0, 1)[asked].to(device), directions.flatten(0, 1)[asked].to(device))
        rgb = torch.zeros(len(asked), 3)
        rgb[asked] = point_field(model).query(points).rgb.float().cpu()
        basis = harmonics(directions)
        weighted = (basis * weight[..., None]).mT
        left = weighted @ basis + ridge * weight.sum(dim=1)[:, None, None]
        fitted[part] = torch.linalg.solve(left, weighted @ rgb.view(*chosen.shape, 3))
        report("colors", part.stop / len(places))
    return sharpened(fitted, seen.voxels, grid.optical.shape)


def sharpened(
    fitted: Float[Tensor, "voxels harmonics 3"], voxels: Int[ndarray, "voxels 3"], shape: tuple[int, ...]
) -> Float[Tensor, "voxels harmonics 3"]:
    """Return coefficients of voxels in a grid that differ more from those of their six neighbors.

    Mixing between voxels makes them differ less.
    """
    values = fitted.flatten(1).numpy()
    number = np.full([side + 2 for side in shape], -1, np.int32)
    number[tuple(voxels.T + 1)] = np.arange(len(voxels))
    mean, count = np.zeros_like(values), np.zeros((len(values), 1), np.float32)
    for axis, way in np.ndindex(3, 2):
        there = voxels + 1
        there[:, axis] += 2 * way - 1
        other = number[tuple(there.T)]
        known = other >= 0
        mean[known] += values[other[known]]
        count[known] += 1.0
    apart = np.where(count > 0, values - mean / np.maximum(count, 1.0), 0.0)
    return torch.from_numpy(values + SHARPER * apart).view_as(fitted)


def to_bytes_of_colors(fitted: Float[Tensor, "voxels harmonics 3"]) -> UInt8[Tensor, "voxels channels"]:
    """Return bytes, channel by channel: the first as the color that it is, the others within their ranges."""
    base = (fitted[:, :1] * DEGREE_1).clamp(0, 1) * 255.0
    ranges = torch.tensor([RANGES[0]] * 3 + [RANGES[1]] * 5)[: fitted.shape[1] - 1, None]
    others = in_coarse_steps(fitted[:, 1:] / ranges * 127.0 + NO_CHANGE)
    return torch.cat([base, others], dim=1).round().to(torch.uint8).flatten(1)


def in_coarse_steps(coefficients: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """Return the nearest bytes that coefficients of degree 1 and 2 may have.

    >>> in_coarse_steps(torch.tensor([0.0, 129.0, 133.0, 255.0])).tolist()
    [8.0, 128.0, 136.0, 248.0]
    """
    most = 127 // COARSE
    return COARSE * ((coefficients - NO_CHANGE) / COARSE).round().clamp(-most, most) + NO_CHANGE

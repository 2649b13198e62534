"""The colours of voxels as spherical harmonics, fitted to what the field says in the directions they are seen from."""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from torch import Tensor
from torch.nn import functional

from nerf_lightning.export.baking.baked_field import NO_CHANGE
from nerf_lightning.export.density_grid import Report
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
# What holds back coefficients of degree 1 and 2, as a share of a voxel's light.
RIDGE = 0.02
# Half range of the bytes of coefficients, of degree 1 and of degree 2.
RANGES = (0.6, 0.6)
# Their bytes are multiples of this: such small changes are not seen, and few different bytes are packed well.
COARSE = 8
# The part of a view's cone that a grid of pixels over it may miss.
MARGIN = 0.02
# How much more colours differ from their neighbours' than the field's.
SHARPER = 0.5
# In normalised device coordinates, from the far end.
LEAST_DISPARITY = 1e-3


def camera_views(record: SceneRecord) -> tuple[Float[ndarray, "cameras 4"], Float[ndarray, "cameras 7"]]:
    """Return where the training cameras are in the field's space, homogeneous, and their cones in the world.

    A cone is a centre, an axis and the cosine of the widest angle. The way from a place p to a camera is xyz - w p:
    normalised device coordinates keep straight lines, and may put a camera beyond infinity.
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


def in_world(places: Float[Tensor, "voxels 3"], record: SceneRecord) -> Float[Tensor, "voxels 3"]:
    """Return where places of the field's space lie in the world; what is at infinity, far away."""
    if record.cameras.ndc is None:
        return places
    z = 2.0 / (places[:, 2:] - 1.0).clamp(max=-LEAST_DISPARITY)
    return torch.cat([-places[:, :2] * z / record.cameras.ndc[0], z], dim=1)


def fitted_colors(
    model: Model,
    places: Float[Tensor, "voxels 3"],
    world: Float[Tensor, "voxels 3"],
    cameras: Int[ndarray, "voxels looks"],
    light: Float[ndarray, "voxels looks"],
    centers: Float[Tensor, "cameras 3"],
    num_harmonics: int,
    tile_points: int,
    report: Report,
) -> Float[Tensor, "voxels harmonics 3"]:
    """Return the coefficients that fit the field's colours best, weighted by the light that arrives.

    min_c sum_k w_k |Y(d_k) c - rgb(d_k)|^2 + ridge |c_{l > 0}|^2 sum_k w_k, for each voxel and channel.

    Args:
        model: its last level is asked.
        places: of the voxels, in the field's space.
        world: and in the world, where directions are those of cameras.
        cameras: numbers of some that see each; -1: no more.
        light: how much arrives there.
        centers: where the cameras stand, in the world.
        num_harmonics: 1, 4 or 9.
        tile_points: most points at once.
        report: told how much is done.
    """
    device = next(model.parameters()).device
    harmonics = SphericalHarmonicsEncoder(math.isqrt(num_harmonics))
    looks = cameras.shape[1]
    ridge = RIDGE * torch.eye(num_harmonics)
    ridge[0, 0] = 1e-6
    fitted = torch.empty(len(places), num_harmonics, 3)
    for part in tiles(len(places), max(1, tile_points // looks)):
        chosen = torch.from_numpy(cameras[part]).long()
        weight = torch.from_numpy(light[part]) * (chosen >= 0)
        at = places[part, None].expand(-1, looks, -1)
        directions = functional.normalize(world[part, None] - centers[chosen], dim=-1)
        asked = (chosen >= 0).flatten()
        points = Points(at.flatten(0, 1)[asked].to(device), directions.flatten(0, 1)[asked].to(device))
        rgb = torch.zeros(len(asked), 3)
        rgb[asked] = point_field(model).query(points).rgb.float().cpu()
        basis = harmonics(directions)
        weighted = (basis * weight[..., None]).mT
        left = weighted @ basis + ridge * weight.sum(dim=1)[:, None, None]
        fitted[part] = torch.linalg.solve(left, weighted @ rgb.view(*chosen.shape, 3))
        report("colours", part.stop / len(places))
    return fitted


def sharpened(
    fitted: Float[Tensor, "voxels harmonics 3"], voxels: Int[ndarray, "voxels 3"], shape: tuple[int, ...]
) -> Float[Tensor, "voxels harmonics 3"]:
    """Return coefficients of voxels in a grid that differ more from those of their six neighbours.

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
    """Return bytes, channel by channel: the first as the colour that it is, the others within their ranges."""
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

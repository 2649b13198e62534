"""The surface that the views see, as a mesh: their rendered depth, fused into one truncated signed distance.

Truncation and resolution: `conf/what/mesh.yaml`.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.export.base import Report, require_kernels
from nerf_lightning.extensions.geometry_exports.density_grid import Lattice
from nerf_lightning.extensions.geometry_exports.density_mesh import marching_cubes
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import for_terminal
from nerf_lightning.nerf.geometry.cameras import all_pixels, pinhole_cameras, resized
from nerf_lightning.nerf.geometry.subset import evenly_spaced_subset
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.tiles import weighted_renderings
from nerf_lightning.nerf.randomness import fold
from nerf_lightning.nerf.rendering.ray_statistics import median_distances
from nerf_lightning.nerf.types.scene import Background, Cameras, SceneRecord

BYTES_PER_POINT = 12  # The distance, its weight, and as much as one of them for the mesh.
# Maximum number of fused views, and of pixels of the longer side of their pictures, which otherwise equals the grid's
# cells.
VIEWS, LONGEST = 60, 512
# A view at a grazing angle counts little; an empty pixel less than a surface; a coarse view less than a fine one.
LEAST_COSINE, NOTHING, LEAST_SHARE = 0.05, 0.3, 0.25
# Half the weight of one view that faces the surface: surfaces with less total weight are discarded.
LEAST_WEIGHT = 0.5


def mesh_of_depth(
    model: Model,
    record: SceneRecord,
    lattice: Lattice,
    truncation: float,
    min_opacity: float,
    tile_points: int,
    report: Report,
) -> tuple[Float[ndarray, "vertices 3"], Int[ndarray, "faces 3"]]:
    """Return vertices (scene frame) and faces of the surface that training views see; it is open where none looks.

    `truncation` is the distance in cells before and behind a surface within which distances are kept.
    """
    fuse = require_kernels(
        f"{__package__}.tsdf_fusion", "what.surface=tsdf", "Reinstall numba, or use what.surface=density."
    )
    lower, reach = lattice.lower.numpy(), truncation * lattice.spacing
    distance, weight = np.zeros(lattice.shape, np.float32), np.zeros(lattice.shape, np.float32)
    rays_of = depth_rays(record, max(lattice.shape))
    cameras = rays_of.cameras
    for view in range(len(cameras.width)):
        depth, trust = depth_view(model, record.background, rays_of, view, lattice.spacing, min_opacity, tile_points)
        numbers = torch.cat([cameras.c2w[view].reshape(-1), cameras.focal[view], cameras.center[view]]).numpy()
        fuse.add_view(distance, weight, lower, lattice.spacing, numbers, depth.numpy(), trust.numpy(), reach)
        report("depth", (view + 1) / len(cameras.width))
    if not ((weight > 0) & (distance < 0)).any():
        raise InputError(
            f"There is no surface to export: no training view of {for_terminal(record.name)} sees anything opaque in "
            "its box. Train longer, or correct the box (scene.aabb_half) or the cameras' poses, and train again."
        )
    np.negative(distance, out=distance)
    vertices, faces = marching_cubes(distance, 0.0, report)
    del distance
    faces = faces[_observed_faces(vertices, faces, weight)]
    if not len(faces):
        raise InputError(
            f"No surface of {for_terminal(record.name)} is seen well enough to be a mesh: all of it is seen only at "
            "grazing angles or by coarse pixels. Give a smaller what.resolution, or what.surface=density."
        )
    return lattice.to_scene(vertices), faces


def _observed_faces(
    vertices: Float[ndarray, "vertices 3"], faces: Int[ndarray, "faces 3"], weight: Float[ndarray, "x y z"]
) -> ndarray:
    """Return which faces are in cells whose eight corners are known: elsewhere the surface would be made up."""
    cell = np.floor(vertices[faces].mean(axis=1)).astype(np.int64)
    cell = np.minimum(cell, np.array(weight.shape) - 2)
    known = np.ones(len(faces), bool)
    for corner in np.ndindex(2, 2, 2):
        known &= weight[tuple((cell + corner).T)] >= LEAST_WEIGHT
    return known


def depth_view(
    model: Model,
    background: Background,
    rays_of: RayGenerator,
    view: int,
    spacing: float,
    min_opacity: float,
    tile_points: int,
) -> tuple[Float[Tensor, "height width"], Float[Tensor, "height width"]]:
    """Return one view's depth of the surface and its weight; `spacing` is that of the grid, in scene units.

    The depth is the distance along each ray at which half of the absorbed light was absorbed (inf: the ray hits
    nothing); the weight is the cosine of the angle to the surface, reduced if a pixel covers many cells.
    """
    rays = rays_of(all_pixels(rays_of.cameras, view))
    flat = rays.map(lambda part: part.flatten(0, 1)).to(next(model.parameters()).device)
    depths, opacities = [], []
    for part, levels in weighted_renderings(model, flat, background, fold(0, "surface"), tile_points):
        depths.append(median_distances(levels[-1], part).cpu())
        opacities.append(levels[-1].opacity.cpu())
    depth = torch.cat(depths).view(rays.near.shape).float()
    meets = torch.cat(opacities).view(rays.near.shape) > min_opacity
    # Differences are steep next to an edge: it is unknown which surface pixels there see.
    down, along = torch.gradient(rays.origins + depth[..., None] * rays.directions, dim=(0, 1))
    normals = normalize(torch.linalg.cross(down, along), dim=-1)
    cosine = (normals * rays.directions).sum(dim=-1).abs().clamp(min=LEAST_COSINE)
    share = (spacing * rays_of.cameras.focal[view].min() / depth).clamp(LEAST_SHARE, 1.0)
    trust = torch.where(meets, cosine * share, NOTHING)
    return torch.where(meets, depth, torch.inf), trust.float()


def depth_rays(record: SceneRecord, cells: int) -> RayGenerator:
    """Return the rays of pinhole cameras with the poses of training views: depth is rendered, so no lens is needed.

    The longer side of a picture has as many pixels as the longest side of the grid has cells, at most `LONGEST`.
    """
    views = [view for view in record.splits["train"] if record.far[view] > record.near[view]]
    chosen = evenly_spaced_subset(views, VIEWS)
    cameras, near, far = record.cameras[chosen], record.near[chosen], record.far[chosen]
    longest = min(cells, LONGEST)
    if cameras.lens_model == "equirectangular":
        faces = len(CUBE)
        return RayGenerator(_cube(cameras, longest), near.repeat_interleave(faces), far.repeat_interleave(faces))
    share = longest / torch.maximum(cameras.width, cameras.height)
    width, height = ((share * size).round().long().clamp(min=2) for size in (cameras.width, cameras.height))
    pinholes = replace(cameras, lens=torch.zeros_like(cameras.lens), lens_model="pinhole")
    return RayGenerator(resized(pinholes, width, height), near, far)


# Right, up and back of cameras that together cover all directions, in the axes of one: ahead, left, back, right, up,
# down.
CUBE = (
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
)


def _cube(cameras: Cameras, size: int) -> Cameras:
    """Return six pinholes in place of each panorama."""
    turned = torch.tensor(CUBE).to(cameras.c2w).mT
    axes = (cameras.c2w[:, None, :, :3] @ turned).flatten(0, 1)
    c2w = torch.cat([axes, cameras.c2w[:, :, 3:].repeat_interleave(len(CUBE), dim=0)], dim=-1)
    return pinhole_cameras(c2w, 0.5 * size, size, size)

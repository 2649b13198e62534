"""From a model to bytes in blocks: densities, who sees them, and their colors."""

import numpy as np
import torch
from jaxtyping import Bool, Int, UInt8
from numpy import ndarray

from nerf_lightning.export.baking.baked_field import BakedField, to_bytes_of_density
from nerf_lightning.export.baking.density import LEAST_OPTICAL, DensityGrid, density_grid, dilated
from nerf_lightning.export.baking.marcher import STEP
from nerf_lightning.export.baking.seen_colors import RANGES, SeenVoxels, fitted_colors, to_bytes_of_colors, who_sees
from nerf_lightning.export.density_grid import Report
from nerf_lightning.export.voxel_kernels.layout import SIDE, any_in_blocks, kernels
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import for_terminal
from nerf_lightning.nerf.geometry.cameras import all_pixels, at_most
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import view_rays
from nerf_lightning.nerf.types.scene import SceneRecord

# Voxels that stop least light are left out, as long as all of them together stop no larger a share of it: fog that is
# hardly seen costs as much as walls.
SHARE_LEFT_OUT = 0.035
# Rays through the training views that are followed, at most: every other pixel tells as much.
FOLLOWED_RAYS = 1_000_000
CLOSED = 0.98  # A scene that stops so much of their light is one that none comes from behind of.
# Values at which all but so much of it is stopped are kept, and their neighbors: where the scene is closed, and where
# what is left out would let the background through.
LEFT_OUT_OF_CLOSED, LEFT_OUT = 0.01, 0.002


def bake(
    model: Model, record: SceneRecord, resolution: int, num_harmonics: int, tile_points: int, report: Report
) -> BakedField:
    """Return what is dense and seen of a model's field."""
    grid = density_grid(model, record, resolution, tile_points, report)
    closed = False
    if grid.contraction is None:
        voxels = np.argwhere(dilated(grid.optical > LEAST_OPTICAL)).astype(np.int32)
        around = who_sees(grid, voxels, record, num_harmonics, report)
        kept = _stopping(grid, around)
    else:
        kept, closed = _lit(grid, record)
        report("lit", 1.0)
        around = who_sees(grid, np.argwhere(kept).astype(np.int32), record, num_harmonics, report)
    if not (kept.any() and (around.cameras[:, 0] >= 0).any()):
        raise InputError(
            f"Nothing of {for_terminal(record.name)} is seen: no training camera sees anything that has density. "
            "Correct the box (scene.aabb_half) or the cameras' poses, and train again."
        )
    grid.optical[~kept] = 0.0
    colored = around.only((around.cameras[:, 0] >= 0) & kept[tuple(around.voxels.T)])
    fitted = fitted_colors(model, record, grid, colored, num_harmonics, tile_points, report)
    return _in_blocks(grid, colored.voxels, to_bytes_of_colors(fitted).numpy().T, closed)


def _stopping(grid: DensityGrid, around: SeenVoxels) -> Bool[ndarray, "x y z"]:
    """Return which voxels stop light that some camera would see, but for the faintest, and their neighbors."""
    stopped = around.light.max(axis=1) * -np.expm1(-grid.optical[tuple(around.voxels.T)])
    order = np.argsort(stopped)
    together = np.cumsum(stopped[order])
    kept = np.zeros(grid.optical.shape, bool)
    kept[tuple(around.voxels[order[together > SHARE_LEFT_OUT * together[-1]]].T)] = True
    return dilated(kept)


def _lit(grid: DensityGrid, record: SceneRecord) -> tuple[Bool[ndarray, "x y z"], bool]:
    """Return which values stop the light that the training views see, and whether next to none gets past them all.

    Most of a scene without bounds lies behind something.
    """
    contraction = grid.contraction
    assert contraction is not None
    views = record.splits["train"]
    width, height = (side[list(views)].double() for side in (record.cameras.width, record.cameras.height))
    smaller = min(1.0, (FOLLOWED_RAYS / float((width * height).sum())) ** 0.5)
    cameras = at_most(record.cameras, max(8, int(smaller * float(torch.maximum(width, height).max()))))
    rays_of = RayGenerator(cameras, record.near, record.far)
    rays = [view_rays(rays_of, all_pixels(cameras, view))[0] for view in views]
    origins = torch.cat([contraction.unit(each.origins).reshape(-1, 3) for each in rays]).float().numpy()
    directions = torch.cat([each.directions.reshape(-1, 3) for each in rays]).float().numpy()
    near = contraction.near / contraction.half
    stopped = kernels("contracted").stopped_light(grid.optical, origins, directions, near, STEP)
    falling = np.sort(stopped[stopped > 0])[::-1]
    together = np.cumsum(falling, dtype=np.float64)
    if not len(falling):
        return stopped > 0, False
    closed = bool(together[-1] >= CLOSED * len(origins))
    share = 1.0 - (LEFT_OUT_OF_CLOSED if closed else LEFT_OUT)
    least = falling[min(int(np.searchsorted(together, share * together[-1])), len(falling) - 1)]
    return dilated(stopped >= least), closed


def _in_blocks(
    grid: DensityGrid, voxels: Int[ndarray, "colored 3"], colors: UInt8[ndarray, "channels colored"], closed: bool
) -> BakedField:
    blocks = _blocks_of(grid.optical > LEAST_OPTICAL)
    place = np.full(blocks.shape, -1, np.int64)
    place[blocks] = np.arange(np.count_nonzero(blocks))
    at, within = np.divmod(voxels, SIDE)
    block = place[tuple(at.T)]
    there = block >= 0
    value = np.ravel_multi_index((block[there], *within[there].T), (int(blocks.sum()), SIDE, SIDE, SIDE))
    order = np.argsort(value)
    colored = np.zeros((int(blocks.sum()), SIDE, SIDE, SIDE), bool)
    colored.reshape(-1)[value] = True
    (nx, ny, nz), side = blocks.shape, SIDE
    values = grid.optical.reshape(nx, side, ny, side, nz, side).transpose(0, 2, 4, 1, 3, 5)
    (x, y, z), (a, b, c) = grid.lower.tolist(), grid.spacing.tolist()
    return BakedField(
        lower=(x, y, z),
        spacing=(a, b, c),
        shape=(nx, ny, nz),
        blocks=np.flatnonzero(blocks).astype(np.int32),
        density=to_bytes_of_density(values[blocks]),
        colored=colored,
        colors=np.ascontiguousarray(colors[:, there][:, order]),
        ranges=RANGES,
        contraction=grid.contraction,
        closed=closed,
    )


def _blocks_of(dense: Bool[ndarray, "x y z"]) -> Bool[ndarray, "bx by bz"]:
    """Return the blocks in which something lies, or on whose border."""
    padded = np.pad(dense, ((0, 1),) * 3)
    found = dense.copy()
    for a, b, c in np.ndindex(2, 2, 2):
        # A block's tile reaches one value further: what stands there is the first of the next block.
        found |= padded[a : a + dense.shape[0], b : b + dense.shape[1], c : c + dense.shape[2]]
    return any_in_blocks(found, SIDE)
